"""Lenses that are no pinholes, and undistortion of what they recorded."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ..errors import StgaError
from .camera import Camera

MIN_RADIUS = 1e-9
"""Radius below which an angle and its tangent are the same number, and parameters have no
effect."""
ZOOM_RANGE = (0.5, 2.0)
"""Range of the pinhole's focal length over the lens's: a fisheye's rim leaves few pixels inside."""
ZOOM_STEPS = 30
"""Focal lengths that are tried in this range."""
BORDER_POINTS = 33
"""Points along a side of the image at which it is checked that all of it was recorded."""
CACHED_MAPS = 32
"""Lenses whose maps are kept: 6 bytes a pixel each."""
Intrinsics = tuple[int, int, float, float, float, float]  # Width, height, fl_x, fl_y, cx, cy


@dataclass(frozen=True)
class Lens:
    """Distortion of normalized image points, applied in this order.

    projection  how the angle θ off the axis becomes a radius: "perspective" (tan θ), "fisheye" (θ),
                "equisolid fisheye" (2 sin θ/2), "field of view" (2 tan θ tan ω/2 → its arc tangent
                / ω) or "division" (r with r / (1 + k r²) = tan θ)
    parameter   ω (radians) of "field of view", k of "division"
    radial      k1, k2, … of 1 + k1 r² + k2 r⁴ + …, any number
    rational    the same for the denominator (k4 to k6 of OpenCV's rational model)
    tangential  p1, p2 as OpenCV counts them: x += 2 p1 x y + p2 (r² + 2 x²), y += p1 (r² + 2 y²) +
                2 p2 x y
    prism       s1 to s4: x += s1 r² + s2 r⁴, y += s3 r² + s4 r⁴
    affine      b1, b2 as fractions of the focal length: x += b1 x + b2 y
    """

    projection: str = "perspective"
    radial: tuple[float, ...] = ()
    rational: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    affine: tuple[float, float] = (0.0, 0.0)
    parameter: float = 0.0

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Recorded points (…, 2) of ideal ones: both (x, y) / depth, x right, y down, not yet in
        pixels."""
        points = np.asarray(points, np.float64)
        if self.projection != "perspective":
            tangent = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), MIN_RADIUS)
            points = points * self._radius(tangent) / tangent
        x, y = np.moveaxis(points, -1, 0)
        square = x * x + y * y
        factor = np.polyval((*self.radial[::-1], 1.0), square)
        factor = factor / np.polyval((*self.rational[::-1], 1.0), square)
        (p1, p2) = self.tangential
        (s1, s2, s3, s4) = self.prism
        (b1, b2) = self.affine
        u = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square)
        v = y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square)
        return np.stack([u + b1 * u + b2 * v, v], axis=-1)

    def _radius(self, tangent: np.ndarray) -> np.ndarray:
        if self.projection == "fisheye":
            return np.arctan(tangent)
        if self.projection == "equisolid fisheye":
            return 2 * np.sin(np.arctan(tangent) / 2)
        if abs(self.parameter) < MIN_RADIUS:
            return tangent
        if self.projection == "field of view":
            return np.arctan(2 * tangent * np.tan(self.parameter / 2)) / self.parameter
        with np.errstate(invalid="ignore"):  # NaN beyond the widest angle that the lens shows
            return 2 * tangent / (1 + np.sqrt(1 - 4 * self.parameter * tangent**2))


@dataclass(frozen=True)
class Undistortion:
    """Resampling of recorded images (`recorded`, `lens`) to those of the ideal pinhole `camera`."""

    recorded: Camera
    lens: Lens
    camera: Camera

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """(H, W) or (H, W, C) uint8, bicubic; gray images are masks and interpolated linearly."""
        import cv2

        maps = _maps(self.recorded.intrinsics, self.lens, self.camera.intrinsics)
        method = cv2.INTER_CUBIC if image.ndim == 3 else cv2.INTER_LINEAR
        return cv2.remap(image, *maps, method, borderMode=cv2.BORDER_REPLICATE)


def undistortion(recorded: Camera, lens: Lens, where: str) -> Undistortion | None:
    """The undistortion of a camera's frames; None for an ideal lens. The pinhole keeps size, pose,
    principal point and aspect; its focal length is the shortest with which every pixel was
    recorded. Raises StgaError, beginning with `where`, without OpenCV, and for a lens that folds
    the image."""
    if lens.projection == "perspective" and not any(
        (*lens.radial, *lens.rational, *lens.tangential, *lens.prism, *lens.affine)
    ):
        return None
    try:
        import cv2  # noqa: F401
    except ImportError as error:
        raise StgaError(
            f"{where}: its lens is distorted; undistorting needs opencv-python-headless"
        ) from error
    zoom = _least_zoom(recorded.intrinsics, lens)
    if zoom is None:
        raise StgaError(
            f"{where}: the distortion of its lens folds the image; expected coefficients of "
            "this camera"
        )
    ideal = replace(recorded, fl_x=recorded.fl_x * zoom, fl_y=recorded.fl_y * zoom)
    return Undistortion(recorded, lens, ideal)


@lru_cache(CACHED_MAPS)
def _least_zoom(recorded: Intrinsics, lens: Lens) -> float | None:
    """The least zoom of ZOOM_RANGE with which every pixel was recorded; None without any."""
    low, high = ZOOM_RANGE
    if not _is_inside(recorded, lens, high):
        return None
    for _ in range(ZOOM_STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if _is_inside(recorded, lens, middle) else (middle, high)
    return high


def _is_inside(recorded: Intrinsics, lens: Lens, zoom: float) -> bool:
    """Whether the pinhole's border was recorded, and the lens spreads all rays to it outward."""
    width, height, *intrinsics = recorded
    focal = intrinsics[:2]
    center = intrinsics[2:]
    along = np.linspace(0, 1, BORDER_POINTS)
    edge = np.concatenate([np.stack([along, side], axis=1) for side in (0 * along, 0 * along + 1)])
    pixels = np.concatenate([edge, edge[:, ::-1]]) * [width, height]
    rays = along[:, None, None] * ((pixels - center) / focal / zoom)
    with np.errstate(all="ignore"):  # coefficients of no lens overflow, which is checked below
        distorted = lens.distort(rays)
        found = distorted[-1] * focal + center
    if not np.isfinite(distorted).all() or (found < 0).any() or (found > [width, height]).any():
        return False
    return bool((np.diff(np.linalg.norm(distorted, axis=-1), axis=0) > 0).all())


@lru_cache(CACHED_MAPS)
def _maps(recorded: Intrinsics, lens: Lens, ideal: Intrinsics) -> tuple[Any, Any]:
    """OpenCV's fixed-point maps; its pixel centers are whole numbers, ours lie at .5."""
    import cv2

    opencv: Any = cv2  # whose type stubs lack the second map's None
    width, height, fl_x, fl_y, cx, cy = ideal
    maps = np.empty((height, width, 2), np.float32)
    x = (np.arange(width) + 0.5 - cx) / fl_x
    for row in range(height):
        points = np.stack([x, np.full(width, (row + 0.5 - cy) / fl_y)], axis=-1)
        maps[row] = lens.distort(points) * recorded[2:4] + np.array(recorded[4:]) - 0.5
    coarse, fine = opencv.convertMaps(maps, None, cv2.CV_16SC2)
    return coarse, fine
