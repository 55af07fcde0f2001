"""Removes the room from the mattes of a still person who was filmed from many sides, by a visual
hull (Laurentini 1994) of which a majority of the images decides instead of all.

The network that finds people was trained on faces: in images from behind, it takes furniture beside
the head for a person. Images from other sides show that nobody is there.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import label

from ..capture.camera import Camera
from ..capture.mesh_geometry import pixels_of
from .appearance import reduced
from .footage.model import Footage, write_png
from .mattes import grown

VOXEL_M = 0.01
"""Edge of the grid's cells in meters."""
MARGIN_M = 0.35
"""Distance around the tracked head, in meters, within which hair and shoulders are sought."""
MIN_AGREEING_FRACTION = 0.85
"""Least fraction of the images that show a cell in which it must lie in the matte: a matte misses
dark hair in front of a dark wall in some."""
MIN_SHOWING = 3
"""Number of images that must show a cell to tell anything of it."""
SIDE_PX = 256
"""Longer side of the mattes that are compared."""
MIN_COVERAGE = 0.5
"""Coverage from which a pixel belongs to the person."""
MIN_CAMERAS = 8
"""Least number of cameras whose mattes are compared."""
MIN_HEAD_FRACTION = 0.9
"""Least fraction of the tracked head's vertices in the hull, which wrong cameras or mattes make
empty. Five takes have 0.997 and more."""


def cut_to_visual_hull(
    footage: Footage, in_meters: Callable[[Camera], Camera], mesh: np.ndarray
) -> tuple[str, ...]:
    """Remove the room from the mattes that were found for many cameras at one timestep. Footage
    with masks of its own keeps them, and mattes stay where they do not agree on the head, of which
    a warning is returned.

    in_meters  a camera of the footage -> the same in the world of `mesh`
    mesh       (V, 3) the tracked head in meters
    """
    timestep = footage.timesteps[0]
    files = [camera.mattes[timestep] for camera in footage.cameras if timestep in camera.mattes]
    is_still = len(footage.timesteps) == 1 and len(files) == len(footage.cameras)
    if not is_still or len(files) < MIN_CAMERAS:
        return ()
    mattes = [np.asarray(camera.mask(timestep)) for camera in footage.cameras]
    cameras = [in_meters(camera.camera) for camera in footage.cameras]
    found = where_person_is(mattes, cameras, mesh)
    if _fraction_inside(found, cameras, mesh) < MIN_HEAD_FRACTION:
        return ("the mattes do not agree on where the head is; the room is not removed from them",)
    for file, matte, person in zip(files, mattes, found, strict=True):
        write_png(file, np.where(person, matte, np.uint8(0)))
    return ()


def _fraction_inside(
    masks: Sequence[np.ndarray], cameras: Sequence[Camera], mesh: np.ndarray
) -> float:
    """Median over the cameras of the fraction of the vertices in the image that a mask covers."""
    fractions = []
    for mask, camera in zip(masks, cameras, strict=True):
        x, y, inside = pixels_of(mesh, camera)
        fractions += [mask[y[inside], x[inside]].mean()] if inside.any() else []
    return float(np.median(fractions)) if fractions else 0.0


def where_person_is(
    mattes: Sequence[np.ndarray], cameras: Sequence[Camera], mesh: np.ndarray
) -> list[np.ndarray]:
    """(H, W) bool for each camera: where its matte may show the person, with a margin of one cell.

    mattes   (H, W) uint8, 255 on the person, one for each camera
    cameras  in meters, all at one moment
    mesh     (V, 3) the tracked head in meters
    """
    import cv2

    small = [_small(matte, camera) for matte, camera in zip(mattes, cameras, strict=True)]
    axes = [
        np.arange(low - MARGIN_M, high + MARGIN_M, VOXEL_M)
        for low, high in zip(mesh.min(0), mesh.max(0), strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    showing, agreeing = np.zeros((2, len(points)), np.int32)
    for matte, camera in small:
        x, y, inside = pixels_of(points, camera)
        showing += inside
        agreeing += inside & grown(cv2, matte, _pixels(VOXEL_M / 2, camera, mesh))[y, x]
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
        x, y, inside = pixels_of(points, reduced_camera)
        covered = np.zeros((reduced_camera.height, reduced_camera.width), bool)
        covered[y[inside], x[inside]] = True
        covered = grown(cv2, covered, _pixels(VOXEL_M, reduced_camera, mesh))
        size = camera.width, camera.height
        found.append(
            cv2.resize(covered.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        )
    return found


def _small(matte: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Where a matte covers pixels of a smaller image, (h, w) bool, and the camera of that."""
    scaled = camera.scaled(min(1.0, SIDE_PX / max(camera.width, camera.height)))
    pixels = reduced(matte, (scaled.width, scaled.height))
    return pixels >= MIN_COVERAGE * 255, scaled


def _pixels(length_m: float, camera: Camera, mesh: np.ndarray) -> float:
    """Pixels that a length takes at the head's distance, at least one."""
    depth_m = float(np.median(camera.project(mesh)[1]))
    return max(1.0, length_m * camera.fl_x / max(depth_m, length_m))
