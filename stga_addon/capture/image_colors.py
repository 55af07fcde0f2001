"""Colors of a mesh's triangles, and of points, as images show them."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from .images import read_image, read_view
from .mesh_geometry import connected_parts, pixels_of, rasterize, triangle_normals
from .model import Capture, View, evenly_spread, views_by_timestep

SAMPLED_HEIGHT_PIXELS = 400
"""Images higher than this are shrunk to it: triangles are then two or three pixels wide."""
MASK_EDGE_PIXELS = 3
"""Along the mask's edge, colors are mixed with the background."""
MAX_LATER_TIMESTEPS = 6
"""Timesteps that are read after the first."""
MAX_LATER_VIEWS = 2
"""Views of each of these timesteps."""
MIDDLE_GRAY = 0.5
"""Brightness, 0…1, of splats that no view shows."""
MIN_ONE_SIDED_FRACTION = 0.05
"""Area of the triangles that no view shows, but whose mirror images are visible, as a fraction of
the mesh; below it, the cameras stand on both sides of the head."""
MAX_ASYMMETRY_FRACTION = 0.015
"""Largest median distance of a symmetric mesh from its mirror image, of its diagonal."""


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
    by_timestep = views_by_timestep(views)
    color, pixels = mean_colors(capture, by_timestep.pop(views[0].timestep))
    visible = pixels > 0
    later: list[View] = []  # a few, of timesteps that are evenly spread, by other cameras in each
    for n, timestep in enumerate(evenly_spread(sorted(by_timestep), MAX_LATER_TIMESTEPS)):
        step = -(-len(by_timestep[timestep]) // MAX_LATER_VIEWS)
        later += by_timestep[timestep][n % step :: step]
    late_color, pixels = mean_colors(capture, later)
    late = (pixels > 0) & ~visible
    color[late] = late_color[late]
    visible |= late
    if not visible.any():
        return np.full(color.shape, MIDDLE_GRAY)
    hidden, mirrored = mirror_images(capture, ~visible, visible)
    area = np.linalg.norm(triangle_normals(capture.neutral[capture.faces]), axis=1)
    if area[hidden].sum() >= MIN_ONE_SIDED_FRACTION * area.sum():
        color[hidden] = color[mirrored]
        visible[hidden] = True
    centers = capture.neutral[capture.faces].mean(1)
    others = late if late.any() else visible
    nearest = np.flatnonzero(others)[cKDTree(centers[others]).query(centers)[1]]
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    for number in np.unique(part[visible]):
        members = np.flatnonzero(part == number)
        known = np.flatnonzero((part == number) & visible)
        nearest[members] = known[cKDTree(centers[known]).query(centers[members])[1]]
    return np.asarray(color[nearest])


def mean_colors(capture: Capture, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Mean color (F, 3) in 0…1 of each triangle in the views; (F,) how many pixels show it."""
    total = np.zeros((len(capture.faces), 3))
    count = np.zeros(len(capture.faces))
    for view in views:
        small, image, mask = read_view(view, min(1.0, SAMPLED_HEIGHT_PIXELS / view.camera.height))
        triangle, _ = rasterize(capture.mesh(view.timestep), capture.faces, small.camera)
        inside = triangle >= 0
        if mask is not None:
            inside &= binary_erosion(mask > 127, iterations=MASK_EDGE_PIXELS)
        pixels = image[inside]
        found = triangle[inside]
        count += np.bincount(found, minlength=len(count))
        for channel in range(3):
            total[:, channel] += np.bincount(found, pixels[:, channel], len(count))
    return total / np.maximum(count, 1)[:, None] / 255, count


def mirrored(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of a head, on its other side."""
    return points * [-1, 1, 1] + [2 * points[:, 0].mean(), 0, 0]


def mirror_images(
    capture: Capture, hidden: np.ndarray, visible: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that are `hidden` (F,) bool and whose mirror images are `visible`, and these; none
    where the mesh is not symmetric."""
    centers = capture.neutral[capture.faces].mean(1)
    distance, partner = cKDTree(centers).query(mirrored(centers))
    rows = np.flatnonzero(hidden & visible[partner])
    if np.median(distance) > MAX_ASYMMETRY_FRACTION * np.linalg.norm(
        np.ptp(capture.neutral, axis=0)
    ):
        rows = rows[:0]
    return rows, partner[rows]


def colors_within(
    points: np.ndarray, views: Sequence[View], masks: Sequence[np.ndarray]
) -> np.ndarray:
    """Mean color (N, 3) in 0…1 of points (N, 3) in the views in which they lie within the masks (H,
    W) bool; gray where there is none."""
    total = np.zeros((len(points), 3))
    count = np.zeros(len(points))
    for view, mask in zip(views, masks, strict=True):
        x, y, inside = pixels_of(points, view.camera)
        rows = np.flatnonzero(inside & mask[y, x])
        total[rows] += read_image(view)[y[rows], x[rows]] / 255
        count[rows] += 1
    mean = total / np.maximum(count, 1)[:, None]
    return np.where(count[:, None] > 0, mean, MIDDLE_GRAY)
