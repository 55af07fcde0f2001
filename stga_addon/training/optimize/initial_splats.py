"""The splats that training starts with."""

from dataclasses import replace

import numpy as np

from ...avatar.embedding import face_frames, to_world
from ...avatar.lattice import lattice_splats
from ...avatar.splats import ADDED, SH_C0, Splats, joined
from ...capture.model import Capture
from ..settings import TrainingSettings
from .hull_points import flat_points, hull_points, in_image
from .initial_colors import triangle_colors


def initial_splats(capture: Capture, settings: TrainingSettings) -> Splats:
    """The lattice on the neutral mesh and, if the settings say so, hull points of the first training timestep
    (`flat_points` where a single camera shows it)."""
    lattice = lattice_splats(
        capture.neutral, capture.faces, settings.lattice, settings.sh_degree, convention=settings.convention
    )
    if not settings.teeth:
        lattice = lattice.rows(~teeth_triangles(capture)[lattice.face])
    first = capture.views["train"][0].timestep
    views = [view for view in capture.views["train"] if view.timestep == first]
    lattice.sh[:, 0] = (triangle_colors(capture, capture.views["train"])[lattice.face] - 0.5) / SH_C0
    parts = [lattice]
    if settings.hull_points:
        if len(views) == 1:
            parts.append(flat_points(capture, views[0], settings.convention, settings.sh_degree, settings.torso))
        else:
            parts.append(hull_points(capture, views, settings.convention, settings.sh_degree, settings.torso))
    splats = joined(parts)
    added = {name: np.zeros((len(splats), ADDED[name], 3), np.float32) for name in settings.added}
    return replace(splats, **added)


def unseen_share(capture: Capture, convention: str, splats: Splats) -> np.ndarray:
    """Share (N,) of the cameras of the first training timestep in whose image an unbound splat does not lie.

    0 for bound splats. A hull point outside of most images is held by few masks only, and often in the air.
    """
    share, unbound = np.zeros(len(splats), np.float32), np.flatnonzero(splats.unbound)
    if not len(unbound):
        return share
    first = capture.views["train"][0].timestep
    views = [view for view in capture.views["train"] if view.timestep == first]
    frames = face_frames(capture.mesh(first), capture.faces, capture.neutral, convention)
    points = to_world(splats.rows(unbound), frames).xyz.astype(np.float64)
    share[unbound] = 1 - np.mean([in_image(points, view.camera) for view in views], axis=0)
    return share


def teeth_triangles(capture: Capture) -> np.ndarray:
    """(F,) bool: the triangles of the rows of teeth added to FLAME's mesh; none in any other mesh."""
    masks = {} if capture.flame is None else capture.flame.model.masks
    return np.asarray(np.isin(capture.faces, masks.get("teeth", ())).all(axis=1))
