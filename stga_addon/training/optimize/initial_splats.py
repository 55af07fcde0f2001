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
from .hull_points import flat_points, hull_points, pixels_of

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
    convention, degree, views = settings.convention, settings.sh_degree, capture.views["train"]
    order = settings.first_lattice_order(len(capture.faces))
    lattice = lattice_splats(capture.neutral, capture.faces, order, degree, convention=convention)
    if not settings.teeth and capture.flame is not None:
        teeth = capture.flame.model.masks.get("teeth", ())
        lattice = lattice.rows(~np.isin(capture.faces, teeth).all(axis=1)[lattice.face])
    lattice.sh[:, 0] = (triangle_colors(capture, views)[lattice.face] - 0.5) / SH_C0
    parts, first = [lattice], [view for view in views if view.timestep == views[0].timestep]
    if settings.hull_points and len(first) == 1:
        parts.append(flat_points(capture, first[0], convention, degree, settings.torso))
    elif settings.hull_points:
        parts.append(hull_points(capture, first, convention, degree, settings.torso))
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
    share[unbound] = 1 - np.mean([pixels_of(points, view.camera)[2] for view in views], axis=0)
    return share


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
    by_timestep: dict[int, list[View]] = {}
    for view in views:
        by_timestep.setdefault(view.timestep, []).append(view)
    color, shown = mean_colors(capture, by_timestep.pop(views[0].timestep))
    later: list[View] = []  # a few, of timesteps that are evenly spread, by other cameras in each
    for n, timestep in enumerate(evenly_spread(sorted(by_timestep), MAX_LATER_TIMESTEPS)):
        step = -(-len(by_timestep[timestep]) // MAX_LATER_VIEWS)
        later += by_timestep[timestep][n % step :: step]
    late_color, late = mean_colors(capture, later)
    late &= ~shown
    color[late] = late_color[late]
    shown |= late
    if not shown.any():
        return np.full(color.shape, MIDDLE_GRAY)
    hidden, mirrored = mirror_images(capture, ~shown, shown)
    a, b, c = capture.neutral[capture.faces].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if area[hidden].sum() >= MIN_ONE_SIDED_SHARE * area.sum():
        color[hidden], shown[hidden] = color[mirrored], True
    centers, others = capture.neutral[capture.faces].mean(1), late if late.any() else shown
    nearest = np.flatnonzero(others)[cKDTree(centers[others]).query(centers)[1]]
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    for number in np.unique(part[shown]):
        members, known = np.flatnonzero(part == number), np.flatnonzero((part == number) & shown)
        nearest[members] = known[cKDTree(centers[known]).query(centers[members])[1]]
    return np.asarray(color[nearest])


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
