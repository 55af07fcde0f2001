"""Lenses that a transforms file names; the views of a capture are undistorted as they are read."""

import math
from collections.abc import Sequence
from dataclasses import replace

from ..errors import StgaError, shorten
from .lens import Lens, undistortion
from .transforms import Frame, Record

RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")
TANGENTIAL = ("p1", "p2")
LISTED = (*RADIAL[:4], *TANGENTIAL)  # nerfstudio's order in `distortion_params`
# Camera models as nerfstudio and COLMAP name them.
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "PERSPECTIVE")
PERSPECTIVES = (*PINHOLES, "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular")  # Lenses of instant-ngp
MAX_SHIFT_PX = 0.5  # Largest distortion at the image's corners that is not visible


def distortion(frames: Sequence[Frame]) -> str | None:
    """A sentence about the first frame whose lens is no pinhole by more than MAX_SHIFT_PX, which
    names the fields that say so; None where there is none. Raises StgaError for coefficients that
    are no numbers."""
    return next((found for frame in frames if (found := _distortion_of(frame))), None)


def undistorted(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """The frames with views that are undistorted as they are read, where `distortion` sees one.
    Raises StgaError for a lens that no coefficients make a pinhole's, or whose coefficients fold
    the image."""
    return tuple(frame if _distortion_of(frame) is None else _as_pinhole(frame) for frame in frames)


def _as_pinhole(frame: Frame) -> Frame:
    view = frame.view
    found = undistortion(view.camera, lens_of(frame.record), frame.where)
    if found is None:
        return frame
    return replace(frame, view=replace(view, camera=found.camera, undistortion=found))


def lens_of(record: Record) -> Lens:
    """The lens that a frame names. Raises StgaError for one that is neither a perspective nor a
    fisheye."""
    fisheye = "OPENCV_FISHEYE" if record.values.get("is_fisheye") else "OPENCV"
    model = record.values.get("camera_model") or fisheye
    known = PERSPECTIVES + FISHEYE_MODELS
    other = next((name for name in OTHER_LENSES if record.values.get(name)), None)
    if model not in known or other is not None:
        name = other or "camera_model"
        problem = f"{shorten(record.values.get(name))} is not one of {', '.join(known)}"
        raise StgaError(f"{record.where(name)}: {problem}")
    if model in PINHOLES:
        return Lens()
    given = _coefficients(record)
    *k, p1, p2 = (given.get(name, 0.0) for name in (*RADIAL, *TANGENTIAL))
    if model in FISHEYE_MODELS:
        return Lens("fisheye", radial=tuple(k[:4]))
    if model == "FULL_OPENCV":
        return Lens(radial=tuple(k[:3]), rational=tuple(k[3:]), tangential=(p1, p2))
    return Lens(radial=tuple(k[:4]), tangential=(p1, p2))  # nerfstudio's k4 is that of r⁸


def _coefficients(record: Record) -> dict[str, float]:
    """Those that a frame names, by their names or in a list."""
    given = {name: record.number(name) for name in (*RADIAL, *TANGENTIAL) if record.has(name)}
    listed = record.values.get("distortion_params")
    if isinstance(listed, list):
        numbers = [value for value in listed if isinstance(value, int | float)]
        given |= dict(zip(LISTED, map(float, numbers), strict=False))
    return given


def _distortion_of(frame: Frame) -> str | None:
    record = frame.record
    camera = frame.view.camera
    model = record.values.get("camera_model") or "OPENCV"
    flags = ("is_fisheye", *OTHER_LENSES)
    other = next((name for name in flags if record.values.get(name)), None)
    if model not in PERSPECTIVES or other is not None:
        name = "camera_model" if other is None else other
        return f"{record.where(name)}: is {shorten(record.values.get(name))}, which is no pinhole"
    if model in PINHOLES:
        return None
    given = _coefficients(record)
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
