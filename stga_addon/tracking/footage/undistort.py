"""Undistortion of images: the pinhole camera that fits a lens, and OpenCV's remapping to it."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ...capture.camera import Camera
from ...errors import StgaError
from .lens import Lens

ZOOM_RANGE = 0.5, 2.0
"""Of the pinhole's focal length over the lens's: a fisheye's rim would otherwise leave few pixels
for the middle."""
ZOOM_STEPS = 30
BORDER_POINTS = 33
"""Points along a side of the image at which it is checked that nothing beyond the recorded image is
shown."""
CACHED_MAPS = 32
"""Lenses whose maps are kept: 6 bytes a pixel each."""


@dataclass(frozen=True)
class Undistortion:
    """Resampling of recorded images (`recorded`, `lens`) to those of the ideal pinhole `camera`."""

    recorded: Camera
    lens: Lens
    camera: Camera

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """(H, W) or (H, W, C) uint8, bicubic; gray images are masks and interpolated linearly."""
        cv2 = _opencv()
        maps = _maps(_intrinsics(self.recorded), self.lens, _intrinsics(self.camera))
        method = cv2.INTER_CUBIC if image.ndim == 3 else cv2.INTER_LINEAR
        return np.asarray(cv2.remap(image, *maps, method, borderMode=cv2.BORDER_REPLICATE))


def undistortion(recorded: Camera, lens: Lens, where: str) -> Undistortion | None:
    """The undistortion of a camera's frames; None for an ideal lens.

    The pinhole keeps size, pose, principal point and aspect; its focal length is the shortest with
    which every pixel was recorded. Raises StgaError, beginning with `where`, without OpenCV, and
    for a lens that folds the image.
    """
    if lens.is_ideal:
        return None
    try:
        _opencv()
    except ImportError as error:
        raise StgaError(
            f"{where}: its lens is distorted; undistorting needs opencv-python-headless"
        ) from error
    zoom = _zoom(recorded, lens, where)
    return Undistortion(
        recorded, lens, replace(recorded, fl_x=recorded.fl_x * zoom, fl_y=recorded.fl_y * zoom)
    )


def _zoom(recorded: Camera, lens: Lens, where: str) -> float:
    """The shortest focal length, as a factor, with which the border of the image shows recorded
    pixels only."""
    low, high = ZOOM_RANGE
    if not _is_inside(recorded, lens, high):
        raise StgaError(
            f"{where}: the distortion of its lens folds the image; expected coefficients of this camera"
        )
    for _ in range(ZOOM_STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if _is_inside(recorded, lens, middle) else (middle, high)
    return high


def _is_inside(recorded: Camera, lens: Lens, zoom: float) -> bool:
    """Whether the pinhole's border lies in the recorded image, and the lens spreads all rays to it
    outward."""
    width, height = recorded.width, recorded.height
    along = np.linspace(0, 1, BORDER_POINTS)
    edge = np.concatenate([np.stack([along, side], axis=1) for side in (0 * along, 0 * along + 1)])
    pixels = np.concatenate([edge, edge[:, ::-1]]) * [width, height]
    focal, center = [recorded.fl_x, recorded.fl_y], [recorded.cx, recorded.cy]
    rays = along[:, None, None] * ((pixels - center) / focal / zoom)
    with np.errstate(all="ignore"):  # coefficients of no lens overflow, which is checked below
        distorted = lens.distort(rays)
        found = distorted[-1] * focal + center
    if not np.isfinite(distorted).all() or (found < 0).any() or (found > [width, height]).any():
        return False
    return bool((np.diff(np.linalg.norm(distorted, axis=-1), axis=0) > 0).all())


def _intrinsics(camera: Camera) -> tuple[int, int, float, float, float, float]:
    return camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy


@lru_cache(CACHED_MAPS)
def _maps(
    recorded: tuple[int, int, float, float, float, float],
    lens: Lens,
    ideal: tuple[int, int, float, float, float, float],
) -> tuple[Any, Any]:
    """OpenCV's fixed-point maps; its pixel centers are whole numbers, ours lie at .5."""
    width, height, *pinhole = ideal
    fl_x, fl_y, cx, cy = pinhole
    maps = np.empty((height, width, 2), np.float32)
    x = (np.arange(width) + 0.5 - cx) / fl_x
    for row in range(height):
        y = np.full(width, (row + 0.5 - cy) / fl_y)
        maps[row] = (
            lens.distort(np.stack([x, y], axis=-1)) * recorded[2:4] + np.array(recorded[4:]) - 0.5
        )
    coarse, fine = _opencv().convertMaps(maps, None, _opencv().CV_16SC2)
    return coarse, fine


def _opencv() -> Any:
    """OpenCV, which only footage with distorted lenses needs. Raises ImportError."""
    import cv2

    return cv2
