"""Visual hull of a timestep: what all of its images allow to be there, outside the mesh."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_cdt

from .camera import Camera
from .images import WHITE_LEVEL, read_image, read_mask
from .mesh_geometry import MIN_DEPTH_M, pixels_of, silhouette
from .model import View

VOXEL_SIZE_M = 0.004
"""Distance between visual-hull points, on a mesh of a head's size."""
MIN_VOXEL_SIZE_FRACTION = 1 / 200
"""Least size of a voxel as a fraction of the mesh's diagonal, so that the grid of a mesh in
millimeters fits into memory."""
GRID_MARGIN_FRACTION = 0.25
"""Margin of the grid around the mesh's bounding box, as a fraction of its diagonal."""
BLOCK_VOXELS = 5
"""Edge of the blocks that are carved before single voxels are, in voxels."""
MIN_VISIBLE_FRACTION = 0.25
"""Fraction of the views in whose image a voxel must lie; it must be foreground in all of these."""
MIN_EXPOSED_FRACTION = 0.125
"""Fraction of the views in which a voxel must be visible beside the mesh. Otherwise, volumes behind
the head that no view contradicts would become floaters in other views."""
SILHOUETTE_TOLERANCE_FRACTION = 0.01
"""Error of the tracked silhouette, as a fraction of the image height."""
FEW_CAMERAS = 4
"""Largest number of cameras with which a torso's visual hull bulges by centimeters: `TorsoPoints`
are better."""


def voxel_size(mesh: np.ndarray) -> float:
    """Distance in meters between visual-hull points around a mesh (V, 3)."""
    return max(VOXEL_SIZE_M, MIN_VOXEL_SIZE_FRACTION * float(np.linalg.norm(np.ptp(mesh, axis=0))))


def hull_surface(
    mesh: np.ndarray, faces: np.ndarray, views: Sequence[View], voxel: float
) -> np.ndarray:
    """Grid points (N, 3) on the surface of the visual hull that are visible beside the mesh."""
    low = mesh.min(0)
    high = mesh.max(0)
    margin = GRID_MARGIN_FRACTION * np.linalg.norm(high - low)
    axes = [np.arange(a - margin, b + margin, voxel) for a, b in zip(low, high, strict=True)]
    foreground = [foreground_of(view) for view in views]
    min_visible = max(2, MIN_VISIBLE_FRACTION * len(views))
    # first blocks are carved, whose bounding sphere lies in the background of an image, or outside
    # of too many images
    centers = [axis[::BLOCK_VOXELS] + (BLOCK_VOXELS - 1) / 2 * voxel for axis in axes]
    points = np.stack(np.meshgrid(*centers, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.sqrt(3) / 2 * (BLOCK_VOXELS - 1) * voxel
    kept = np.ones(len(points), bool)
    outside = np.zeros(len(points), int)
    for view, mask in zip(views, foreground, strict=True):
        camera = view.camera
        pixels, depth = camera.project(points)
        before = depth - radius > MIN_DEPTH_M
        nearest = np.maximum(depth - radius, MIN_DEPTH_M)
        # Over a sphere, x / z differs from the center's by at most radius · |(x, z)| / (z · (z −
        # radius)).
        focal = [camera.fl_x, camera.fl_y]
        slope = np.hypot(1, (pixels - [camera.cx, camera.cy]) / focal)
        reach = np.ceil((slope * focal).max(1) * radius / nearest) + 1
        beyond = np.maximum(-pixels, pixels - [camera.width, camera.height]).max(1)
        outside += np.where(before, beyond > reach, depth + radius <= MIN_DEPTH_M)
        # Beyond an image, what is background is not known.
        clear = distance_transform_cdt(np.pad(~mask, 1), "chessboard")[1:-1, 1:-1]
        x, y, in_image = pixels_of(points, camera)
        kept &= ~(before & in_image & (clear[y, x] > reach))
    kept &= len(views) - outside >= min_visible
    within = kept.reshape([len(along) for along in centers])
    for number, axis in enumerate(axes):
        within = within.repeat(BLOCK_VOXELS, number).take(range(len(axis)), number)
    # then voxels
    rows = np.nonzero(within)
    points = np.stack([axis[row] for axis, row in zip(axes, rows, strict=True)], axis=1)
    inside = np.ones(len(points), bool)
    visible, exposed = np.zeros((2, len(points)), np.int32)
    for view, mask in zip(views, foreground, strict=True):
        beside = ~wide_silhouette(mesh, faces, view.camera)
        remaining = np.flatnonzero(inside)
        x, y, in_image = pixels_of(points[remaining], view.camera)
        remaining = remaining[in_image]
        x = x[in_image]
        y = y[in_image]
        visible[remaining] += 1
        exposed[remaining] += beside[y, x]
        inside[remaining] = mask[y, x]
    solid = within.copy()
    solid[within] = inside & (visible >= min_visible)
    surface = (solid & ~binary_erosion(solid))[within]
    return np.asarray(
        points[surface & (exposed >= np.maximum(1, MIN_EXPOSED_FRACTION * len(views)))]
    )


def wide_silhouette(mesh: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: pixels that the mesh covers, dilated by the tolerance."""
    tolerance = max(1, round(SILHOUETTE_TOLERANCE_FRACTION * camera.height))
    return np.asarray(binary_dilation(silhouette(mesh, faces, camera), iterations=tolerance))


def foreground_of(view: View) -> np.ndarray:
    """(H, W) bool from the mask or, without one, from the image's difference to white."""
    mask = read_mask(view)
    if mask is not None:
        return np.asarray(mask > 127)
    return np.asarray((read_image(view) < WHITE_LEVEL).any(axis=2))
