"""What belongs to a still person in images from many sides: the part of each matte that the other
images agree with (a visual hull, Laurentini 1994, with a majority instead of all images).

The network that finds people was trained on faces: from behind, furniture near the head passes for
a person. From elsewhere, the same place in space lies before the wall.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import binary_dilation, label

from ..capture.camera import Camera
from ..capture.mesh_geometry import pixels_of
from .appearance import reduced
from .footage.model import Footage, write_png

VOXEL_M = 0.01
"""Edge of the grid's cells in meters."""
MARGIN_M = 0.35
"""Distance around the tracked head, in meters, within which hair and shoulders are sought."""
MIN_AGREEING_FRACTION = 0.85
"""Least fraction of the images that show a cell in which it must lie in the matte: a matte misses
dark hair before a dark wall in some."""
MIN_SHOWING = 3
"""Number of images that must show a cell to tell anything of it."""
SIDE_PX = 256
"""Longer side of the mattes that are compared."""
MIN_COVERAGE = 0.5
"""Coverage from which a pixel belongs to the person."""
MIN_CAMERAS = 8
"""Least number of cameras whose mattes are compared."""


def cut_to_visual_hull(
    footage: Footage, in_meters: Callable[[Camera], Camera], mesh: np.ndarray
) -> None:
    """Remove from the mattes that were found for many cameras at one timestep what is not the
    person's; footage with masks of its own keeps them.

    in_meters  a camera of the footage -> the same in the world of `mesh`
    mesh       (V, 3) the tracked head in meters
    """
    timestep = footage.timesteps[0]
    files = [camera.mattes[timestep] for camera in footage.cameras if timestep in camera.mattes]
    have_masks = len(files) < len(footage.cameras)
    if len(footage.timesteps) > 1 or len(files) < MIN_CAMERAS or have_masks:
        return
    mattes = [np.asarray(camera.mask(timestep)) for camera in footage.cameras]
    cameras = [in_meters(camera.camera) for camera in footage.cameras]
    found = where_person_is(mattes, cameras, mesh)
    for file, matte, person in zip(files, mattes, found, strict=True):
        write_png(file, np.where(person, matte, np.uint8(0)))


def where_person_is(
    mattes: Sequence[np.ndarray], cameras: Sequence[Camera], mesh: np.ndarray
) -> list[np.ndarray]:
    """(H, W) bool for each camera: where its matte may show the person, with a margin of one cell.

    mattes   (H, W) uint8, 255 on the person, one for each camera
    cameras  in meters, all at one moment
    mesh     (V, 3) the tracked head in meters
    """
    small = [_small(matte, camera) for matte, camera in zip(mattes, cameras, strict=True)]
    axes = [
        np.arange(low - MARGIN_M, high + MARGIN_M, VOXEL_M)
        for low, high in zip(mesh.min(0), mesh.max(0), strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    showing, agreeing = np.zeros((2, len(points)), np.int32)
    for matte, camera in small:
        x, y, shown = pixels_of(points, camera)
        showing += shown
        agreeing += shown & _grown(matte, camera, mesh, VOXEL_M / 2)[y, x]
    solid = (showing < MIN_SHOWING) | (agreeing >= MIN_AGREEING_FRACTION * showing)
    connected, _ = label(solid.reshape([len(axis) for axis in axes]))
    rows = [
        np.clip(np.searchsorted(axis, at), 0, len(axis) - 1)
        for axis, at in zip(axes, mesh.T, strict=True)
    ]
    of_head = np.setdiff1d(connected[tuple(rows)], [0])
    points = points[np.isin(connected, of_head).ravel()]
    found = []
    for camera, (_, reduced_camera) in zip(cameras, small, strict=True):
        x, y, shown = pixels_of(points, reduced_camera)
        covered = np.zeros((reduced_camera.height, reduced_camera.width), bool)
        covered[y[shown], x[shown]] = True
        covered = _grown(covered, reduced_camera, mesh, VOXEL_M)
        found.append(_resized(covered, camera))
    return found


def _small(matte: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Where a matte covers pixels of a smaller image, (h, w) bool, and the camera of that."""
    scaled = camera.scaled(min(1.0, SIDE_PX / max(camera.width, camera.height)))
    pixels = reduced(matte, (scaled.width, scaled.height))
    return pixels >= MIN_COVERAGE * 255, scaled


def _grown(covered: np.ndarray, camera: Camera, mesh: np.ndarray, meters: float) -> np.ndarray:
    """(H, W) bool grown by a length at the head's distance."""
    depth = float(np.median(camera.project(mesh)[1]))
    pixels = max(1, round(meters * camera.fl_x / max(depth, meters)))
    return np.asarray(binary_dilation(covered, iterations=pixels))


def _resized(covered: np.ndarray, camera: Camera) -> np.ndarray:
    import cv2

    size = camera.width, camera.height
    return cv2.resize(covered.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
