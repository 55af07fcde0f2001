"""Lens distortion that a transforms file names, which captures, of pinholes, do not have."""

import math
from collections.abc import Sequence

from ..errors import shorten
from .transforms import Frame

RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")
TANGENTIAL = ("p1", "p2")
LISTED = (*RADIAL[:4], *TANGENTIAL)  # nerfstudio's order in `distortion_params`
# Camera models as nerfstudio and COLMAP name them.
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "PERSPECTIVE")
PERSPECTIVES = (*PINHOLES, "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
OTHER_LENSES = ("is_fisheye", "ftheta_p0", "latlong", "equirectangular")  # Of instant-ngp
MAX_SHIFT_PX = 0.5  # At the image's corners, up to which a distortion shows nowhere


def distortion(frames: Sequence[Frame]) -> str | None:
    """A sentence about the first frame whose lens is no pinhole by more than MAX_SHIFT_PX, which
    names the fields that say so; None where there is none. Raises StgaError for coefficients that
    are no numbers."""
    return next((found for frame in frames if (found := _distortion_of(frame))), None)


def _distortion_of(frame: Frame) -> str | None:
    record = frame.record
    camera = frame.view.camera
    model = record.values.get("camera_model") or "OPENCV"
    other = next((name for name in OTHER_LENSES if record.values.get(name)), None)
    if model not in PERSPECTIVES or other is not None:
        name = "camera_model" if other is None else other
        return f"{record.where(name)}: is {shorten(record.values.get(name))}, which is no pinhole"
    if model in PINHOLES:
        return None
    given = {name: record.number(name) for name in (*RADIAL, *TANGENTIAL) if record.has(name)}
    listed = record.values.get("distortion_params")
    if isinstance(listed, list):
        numbers = [value for value in listed if isinstance(value, int | float)]
        given |= dict(zip(LISTED, map(float, numbers), strict=False))
    x = max(camera.cx, camera.width - camera.cx) / camera.fl_x
    y = max(camera.cy, camera.height - camera.cy) / camera.fl_y
    radius = math.hypot(x, y)
    focal = max(camera.fl_x, camera.fl_y)
    shift = sum(
        abs(given.get(name, 0.0)) * radius ** (2 * power + 3) for power, name in enumerate(RADIAL)
    )
    shift += sum(3 * abs(given.get(name, 0.0)) * radius**2 for name in TANGENTIAL)
    if shift * focal <= MAX_SHIFT_PX:
        return None
    names = ", ".join(f"{name} {value:g}" for name, value in given.items() if value)
    return f"{frame.where}: is distorted ({names})"
