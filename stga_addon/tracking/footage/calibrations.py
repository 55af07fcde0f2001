"""Which calibration a footage folder has, and its cameras; those of nerfstudio, instant-ngp and
VHAP (`transforms.json`, with lens distortion) are read here."""

from os.path import isdir, isfile
from pathlib import Path
from typing import Any

from ...capture.transforms import MAX_NUMBER, SPLITS, frame_rate, inside, read_transforms
from ...errors import StgaError, shorten
from ...files import read_json
from .colmap import find_colmap, read_colmap
from .photogrammetry import (
    ImageSize,
    is_metashape,
    is_realitycapture_csv,
    read_metashape,
    read_realitycapture_csv,
    read_realitycapture_xmp,
)
from .shots import Lens, Shot

TRANSFORMS = ("transforms.json", *(f"transforms_{split}.json" for split in SPLITS))
EXPECTED = (
    "transforms.json, a COLMAP model (sparse/0), Metashape's cameras.xml, "
    "RealityCapture's CSV or XMP files"
)
NAMES_IN_WARNING = 5
PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
PERSPECTIVE_MODELS = (*PINHOLE_MODELS, "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def find_calibration(root: Path) -> Path | None:
    """The calibration of a folder, the first of: transforms files, COLMAP, Metashape,
    RealityCapture's CSV and XMP.

    A folder stands for transforms_train.json and its like, for a COLMAP model or for XMP files.
    """
    if (root / TRANSFORMS[0]).is_file():
        return root / TRANSFORMS[0]
    if any((root / name).is_file() for name in TRANSFORMS):
        return root
    colmap = find_colmap(root)
    if colmap is not None:
        return colmap
    found = [
        path
        for pattern, is_own in (("*.xml", is_metashape), ("*.csv", is_realitycapture_csv))
        for path in sorted(root.glob(pattern))
        if isfile(path) and is_own(path)
    ]
    if len(found) > 1:
        raise StgaError(f"{root}: {found[0].name} and {found[1].name} are calibrations; choose one")
    folders = [folder for folder in (root, root / "images") if any(folder.glob("*.xmp"))]
    return next(iter(found + folders), None)


def read_calibration(path: Path, image_size: ImageSize) -> tuple[list[Shot], tuple[str, ...]]:
    """Shots of a calibration file or folder, and a sentence about cameras that it lists without a
    pose.

    image_size: size of the images of a label, which RealityCapture does not write. Raises StgaError
    that names file and field.
    """
    shots, without_pose = _read(path, image_size)
    if not shots:
        raise StgaError(f"{path}: has no camera with a pose")
    if not without_pose:
        return shots, ()
    names, more = ", ".join(without_pose[:NAMES_IN_WARNING]), len(without_pose) - NAMES_IN_WARNING
    rest = f" and {more} more" if more > 0 else ""
    return shots, (f"{path}: left out cameras without a pose: {names}{rest}",)


def _read(path: Path, image_size: ImageSize) -> tuple[list[Shot], list[str]]:
    suffix = path.suffix.lower()
    if isdir(path):
        splits = [path / name for name in TRANSFORMS if (path / name).is_file()]
        model = find_colmap(path)
        if splits:
            return [shot for name in splits for shot in read_nerfstudio(name)], []
        if model is not None:
            return read_colmap(model), []
        return read_realitycapture_xmp(path.glob("*.xmp"), image_size)
    if not isfile(path):
        raise StgaError(f"{path}: does not exist; expected {EXPECTED}")
    if suffix == ".json":
        return read_nerfstudio(path), []
    if suffix == ".xml":
        return read_metashape(path)
    if suffix == ".csv":
        return read_realitycapture_csv(path, image_size), []
    if suffix == ".xmp":
        return read_realitycapture_xmp([path], image_size)
    if suffix in (".bin", ".txt") and find_colmap(path.parent) == path.parent:
        return read_colmap(path.parent), []
    raise StgaError(f"{path}: is no calibration; expected {EXPECTED}")


def read_nerfstudio(path: Path) -> list[Shot]:
    """Entries of a transforms file; `file_path` is the label. Raises StgaError.

    Their `cy` means what VHAP's does where frames have `timestep_index`, else what OpenCV's does
    (`read_transforms`).
    """
    top = read_json(path)
    found = top.get("frames") if isinstance(top, dict) else None
    entries = [each for each in found if isinstance(each, dict)] if isinstance(found, list) else []
    timed = any("timestep_index" in entry for entry in entries)
    frames = read_transforms(path, "vhap" if timed else "opencv")
    timed = timed or any("keyframe" in entry for entry in entries)
    folder, fps, shots = path.parent.resolve(), frame_rate(path, top), []
    for frame, entry in zip(frames, entries, strict=True):
        values, view, where = {**top, **entry}, frame.view, frame.where
        lens, mask, mask_path = _lens(values, where), view.mask, values.get("mask_path")
        if mask is None and isinstance(mask_path, str):  # nerfstudio's
            mask = inside(folder, mask_path, f"{where}.mask_path")
        number = f"{view.camera_index:02d}" if "camera_index" in values else None
        timestep, name = view.timestep if timed else None, frame.camera_id or number
        keeps = top.get("world") == "keep"
        shots.append(
            Shot(view.name, view.camera, lens, where, view.image, timestep, mask, name, fps, keeps)
        )
    return shots


def _lens(values: dict[str, Any], where: str) -> Lens:
    """The lens of a frame, whose fields come before those at the top level."""
    usual = "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV"
    model, known = values.get("camera_model") or usual, PERSPECTIVE_MODELS + FISHEYE_MODELS
    if model not in known:
        raise StgaError(f"{where}.camera_model: {shorten(model)} is not one of {', '.join(known)}")
    if model in PINHOLE_MODELS:
        return Lens()
    coefficients = []
    for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"):
        value = values.get(key) or 0.0
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not abs(value) <= MAX_NUMBER:
            raise StgaError(f"{where}.{key}: expected a finite number, not {shorten(value)}")
        coefficients.append(float(value))
    k1, k2, k3, k4, k5, k6, p1, p2 = coefficients
    if model in FISHEYE_MODELS:
        return Lens("fisheye", radial=(k1, k2, k3, k4))
    if model == "FULL_OPENCV":
        return Lens(radial=(k1, k2, k3), rational=(k4, k5, k6), tangential=(p1, p2))
    return Lens(radial=(k1, k2, k3, k4), tangential=(p1, p2))  # nerfstudio's k4 is that of r⁸
