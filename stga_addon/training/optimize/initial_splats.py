"""The splats that training starts with."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from ...avatar.embedding import face_frames, to_world
from ...avatar.lattice import lattice_splats
from ...avatar.splats import ADDED, SH_C0, Splats, joined
from ...capture.images import read_view
from ...capture.mesh_geometry import connected_parts, rasterize
from ...capture.model import Capture, View, evenly_spread
from ..settings import TrainingSettings
from .hull_points import flat_points, hull_points, in_image

SAMPLED_HEIGHT_PIXELS = 400
"""Images higher than this are shrunk to it: triangles are then two or three pixels wide."""
MASK_EDGE_PIXELS = 3
"""Along the mask's edge, colors are mixed with the background."""
MAX_LATER_TIMESTEPS, MAX_LATER_VIEWS = 6, 2
"""Further timesteps that are read, and views of each."""
MIDDLE_GRAY = 0.5
MIN_ONE_SIDED_SHARE = 0.05
"""Area of the triangles that no view shows, but whose mirror images are shown, as a share of the
mesh: below it, the cameras stand on both sides of the head."""
MAX_ASYMMETRY_SHARE = 0.015
"""Median distance of the mesh from its mirror image, as a share of its diagonal, beyond which it is
not symmetric."""


def initial_splats(capture: Capture, settings: TrainingSettings) -> Splats:
    """The lattice on the neutral mesh and, if the settings say so, hull points of the first
    training timestep (`flat_points` where a single camera shows it)."""
    order = settings.lattice_order(len(capture.faces))
    lattice = lattice_splats(
        capture.neutral, capture.faces, order, settings.sh_degree, convention=settings.convention
    )
    if not settings.teeth:
        lattice = lattice.rows(~teeth_triangles(capture)[lattice.face])
    first = capture.views["train"][0].timestep
    views = [view for view in capture.views["train"] if view.timestep == first]
    lattice.sh[:, 0] = (
        triangle_colors(capture, capture.views["train"])[lattice.face] - 0.5
    ) / SH_C0
    parts = [lattice]
    if settings.hull_points:
        if len(views) == 1:
            parts.append(
                flat_points(
                    capture, views[0], settings.convention, settings.sh_degree, settings.torso
                )
            )
        else:
            parts.append(
                hull_points(capture, views, settings.convention, settings.sh_degree, settings.torso)
            )
    splats = joined(parts)
    added = {name: np.zeros((len(splats), ADDED[name], 3), np.float32) for name in settings.added}
    return replace(splats, **added)


def unseen_share(capture: Capture, convention: str, splats: Splats) -> np.ndarray:
    """Share (N,) of the cameras of the first training timestep in whose image an unbound splat does
    not lie.

    0 for bound splats. A hull point outside of most images is held by few masks only, and often in
    the air.
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
    """(F,) bool: the triangles of the rows of teeth added to FLAME's mesh; none in any other
    mesh."""
    masks = {} if capture.flame is None else capture.flame.model.masks
    return np.asarray(np.isin(capture.faces, masks.get("teeth", ())).all(axis=1))


def triangle_colors(capture: Capture, views: Sequence[View]) -> np.ndarray:
    """Mean color (F, 3) from 0 to 1 of each triangle in the first view's timestep or, if hidden
    there, in later ones.

    Teeth that the lips hide at first have their own color, not that of the lips. Where cameras
    stand on one side of the head only, a triangle of the other side has the color of its mirror
    image. Any other that no view shows has the color of the nearest one of the neutral mesh that is
    connected with it: the back of a head that is seen from the front has the color of its sides.
    Where all connected ones are hidden too, as a back tooth, it is the nearest of those that only
    later timesteps show or, without any, of all. Gray if no view shows any.
    """
    first = views[0].timestep
    color, seen = mean_colors(capture, [view for view in views if view.timestep == first])
    late_color, late = mean_colors(
        capture, _later_views([view for view in views if view.timestep != first])
    )
    late &= ~seen
    color[late] = late_color[late]
    shown = seen | late
    if not shown.any():
        return np.full(color.shape, MIDDLE_GRAY)
    hidden, mirrored = _other_side(capture, shown)
    color[hidden], shown[hidden] = color[mirrored], True
    return np.asarray(color[_nearest_shown(capture, shown, late if late.any() else shown)])


def _later_views(views: Sequence[View]) -> list[View]:
    """A few views of timesteps that are evenly spread, by other cameras in each."""
    timesteps = sorted({view.timestep for view in views})
    chosen: list[View] = []
    for n, timestep in enumerate(evenly_spread(timesteps, MAX_LATER_TIMESTEPS)):
        at_once = [view for view in views if view.timestep == timestep]
        step = -(-len(at_once) // MAX_LATER_VIEWS)
        chosen += at_once[n % step :: step]
    return chosen


def mean_colors(capture: Capture, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Mean color (F, 3) from 0 to 1 of each triangle in the views, and (F,) bool whether any shows
    it."""
    total, count = np.zeros((len(capture.faces), 3)), np.zeros(len(capture.faces))
    for view in views:
        small, image, mask = read_view(view, min(1.0, SAMPLED_HEIGHT_PIXELS / view.camera.height))
        triangle, _ = rasterize(capture.mesh(view.timestep), capture.faces, small.camera)
        shown = triangle >= 0
        if mask is not None:
            shown &= binary_erosion(mask > 127, iterations=MASK_EDGE_PIXELS)
        pixels, found = image[shown], triangle[shown]
        count += np.bincount(found, minlength=len(count))
        for channel in range(3):
            total[:, channel] += np.bincount(found, pixels[:, channel], len(count))
    return total / np.maximum(count, 1)[:, None] / 255, count > 0


def _other_side(capture: Capture, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`mirror_images` of the triangles that are not `shown` (F,) bool; none where they are few."""
    hidden, partner = mirror_images(capture, ~shown, shown)
    corners = capture.neutral[capture.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    few = area[hidden].sum() < MIN_ONE_SIDED_SHARE * area.sum()
    return (hidden[:0], partner[:0]) if few else (hidden, partner)


def mirror_images(
    capture: Capture, hidden: np.ndarray, shown: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that are `hidden` (F,) bool and whose mirror images are `shown`, and these; none
    where the mesh is not symmetric."""
    centers = capture.neutral[capture.faces].mean(1)
    across = centers * [-1, 1, 1] + [2 * centers[:, 0].mean(), 0, 0]
    distance, partner = cKDTree(centers).query(across)
    rows = np.flatnonzero(hidden & shown[partner])
    if np.median(distance) > MAX_ASYMMETRY_SHARE * np.linalg.norm(np.ptp(capture.neutral, axis=0)):
        rows = rows[:0]
    return rows, partner[rows]


def _nearest_shown(capture: Capture, shown: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(F,) the nearest triangle that is `shown` of those connected with each or, if none is, the
    nearest of `others`.

    shown, others (F,) bool.
    """
    centers = capture.neutral[capture.faces].mean(1)
    nearest = np.flatnonzero(others)[cKDTree(centers[others]).query(centers)[1]]
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    for number in np.unique(part[shown]):
        members, known = np.flatnonzero(part == number), np.flatnonzero((part == number) & shown)
        nearest[members] = known[cKDTree(centers[known]).query(centers[members])[1]]
    return np.asarray(nearest)
