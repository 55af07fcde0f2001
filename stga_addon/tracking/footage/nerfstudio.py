"""Cameras of nerfstudio, instant-ngp and VHAP: `transforms.json`, with lens distortion."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from ...capture.transforms import MAX_NUMBER, Frame, frame_rate, inside, read_transforms
from ...errors import StgaError, shorten
from ...files import read_json
from .lens import Lens
from .shots import Shot

PERSPECTIVE_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
)
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def read_nerfstudio(path: Path) -> list[Shot]:
    """Entries of a transforms file; `file_path` is the label. Raises StgaError.

    Their `cy` means what VHAP's does where frames have `timestep_index`, else what OpenCV's does
    (`read_transforms`).
    """
    values = read_json(path)
    entries = values.get("frames") if isinstance(values, dict) else None
    entries = (
        [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []
    )
    timed = any("timestep_index" in entry for entry in entries)
    frames = read_transforms(path, "vhap" if timed else "opencv")
    timed = timed or any("keyframe" in entry for entry in entries)
    folder = path.parent.resolve()
    fps, keeps_world = frame_rate(path, values), values.get("world") == "keep"
    return [
        replace(_shot(folder, frame, {**values, **entry}, timed), fps=fps, keeps_world=keeps_world)
        for frame, entry in zip(frames, entries, strict=True)
    ]


def _shot(folder: Path, frame: Frame, values: dict[str, Any], timed: bool) -> Shot:
    view = frame.view
    return Shot(
        label=view.name,
        camera=view.camera,
        lens=_lens(values, frame.where),
        where=frame.where,
        image=view.image,
        timestep=view.timestep if timed else None,
        mask=view.mask or _mask(folder, values, frame.where),
        camera_name=frame.camera_id
        or (f"{view.camera_index:02d}" if "camera_index" in values else None),
    )


def _mask(folder: Path, values: dict[str, Any], where: str) -> Path | None:
    """nerfstudio's `mask_path`."""
    path = values.get("mask_path")
    return inside(folder, path, f"{where}.mask_path") if isinstance(path, str) else None


def _lens(values: dict[str, Any], where: str) -> Lens:
    """The lens of a frame, whose fields come before those at the top level."""
    model = values.get("camera_model") or (
        "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV"
    )
    if model not in PERSPECTIVE_MODELS + FISHEYE_MODELS:
        known = ", ".join(PERSPECTIVE_MODELS + FISHEYE_MODELS)
        raise StgaError(f"{where}.camera_model: {shorten(model)} is not one of {known}")
    if model in PINHOLE_MODELS:
        return Lens()
    k1, k2, k3, k4, k5, k6, p1, p2 = (_coefficient(values, key, where) for key in COEFFICIENTS)
    if model in FISHEYE_MODELS:
        return Lens("fisheye", radial=(k1, k2, k3, k4))
    if model == "FULL_OPENCV":
        return Lens(radial=(k1, k2, k3), rational=(k4, k5, k6), tangential=(p1, p2))
    return Lens(radial=(k1, k2, k3, k4), tangential=(p1, p2))  # nerfstudio's k4 is that of r⁸


def _coefficient(values: dict[str, Any], key: str, where: str) -> float:
    value = values.get(key) or 0.0
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not abs(value) <= MAX_NUMBER
    ):
        raise StgaError(f"{where}.{key}: expected a finite number, not {shorten(value)}")
    return float(value)
