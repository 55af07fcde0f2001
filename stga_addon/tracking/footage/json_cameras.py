"""Cameras of NeRSemble's and VHAP's camera_params.json, and of 3D Gaussian Splatting's
cameras.json."""

import math
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from ...capture.camera import Camera
from ...capture.lens import Lens
from ...errors import StgaError, shorten
from ...files import read_json
from .shots import Calibrated, ImageSize, Shot, pinhole

CAMERA_PARAMS = "camera_params.json"
"""NeRSemble's and VHAP's file."""
CAMERA_PARAMS_MARK = b'"world_2_cam"'
"""Words of its beginning."""
GAUSSIAN_MARKS = b'"position"', b'"rotation"', b'"fx"'
"""Words of the beginning of 3D Gaussian Splatting's file."""
HEAD_BYTES = 1 << 16
"""Bytes of a file in which they are looked for."""
MAX_OTHER_SIZE = 0.1
"""Relative distance of a principal point from the image's center, up to which a matrix of
intrinsics may belong to the image's size."""


def is_camera_params(path: Path) -> bool:
    """Whether a file of any name holds NeRSemble's matrices, by its beginning."""
    return CAMERA_PARAMS_MARK in _head(path)


def is_gaussian_cameras(path: Path) -> bool:
    """Whether a file of any name is what 3D Gaussian Splatting writes into its output folder."""
    head = _head(path)
    return head.lstrip()[:1] == b"[" and all(mark in head for mark in GAUSSIAN_MARKS)


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(HEAD_BYTES)


def camera_names(path: Path) -> list[str]:
    """Names of the cameras in NeRSemble's file. Raises StgaError."""
    return list(_camera_params(path)["world_2_cam"])


def _camera_params(path: Path) -> dict[str, Any]:
    values = read_json(path)
    if not isinstance(values, dict) or not isinstance(values.get("world_2_cam"), dict):
        raise StgaError(f"{path}: world_2_cam: expected a matrix for each camera")
    return values


def read_camera_params(path: Path, image_size: ImageSize) -> Calibrated:
    """One shot a camera, labelled with its number. `world_2_cam` has OpenCV axes; `intrinsics`, of
    all or of each camera, are of images whose center is about the principal point: where those of
    the footage are smaller or larger by a whole factor, they are scaled. Raises StgaError."""
    values = _camera_params(path)
    poses = values["world_2_cam"]
    shots = []
    sentences = {}
    for name, pose in poses.items():
        where = f"{path}: camera {shorten(name)}"
        matrix = _array(pose, where, "world_2_cam", ((4, 4), (3, 4)))
        given = values.get("intrinsics")
        given = given.get(name) if isinstance(given, dict) else given
        lens = _array(given, where, "intrinsics", ((3, 3), (4, 4), (3, 4)))
        size = image_size(name)
        factor = _factor(size, (float(lens[0, 2]), float(lens[1, 2])), where)
        if factor != 1:
            sentences[factor] = f"intrinsics are of images {factor:g} times as large; scaled"
        lens = lens / factor
        rotation = matrix[:3, :3]
        position = -rotation.T @ matrix[:3, 3]
        focal = float(lens[0, 0]), float(lens[1, 1])
        center = float(lens[0, 2]), float(lens[1, 2])
        camera = pinhole(size, focal, center, rotation, position, where)
        shots.append(Shot(name, camera, Lens(), where))
    return shots, tuple(sentences.values())


def _factor(size: tuple[int, int], center: tuple[float, float], where: str) -> float:
    """How many times larger than images of that size those of the principal point are: a whole
    number, or one divided by it. Raises StgaError for others."""
    ratios = [2 * middle / length for middle, length in zip(center, size, strict=True)]
    mean = sum(ratios) / 2
    factor = 1.0 if mean <= 0 else float(round(mean)) if mean > 1 else 1 / round(1 / mean)
    if not all(abs(ratio / factor - 1) <= MAX_OTHER_SIZE for ratio in ratios):
        raise StgaError(
            f"{where}: intrinsics have the principal point {center[0]:g}, {center[1]:g}, which is "
            f"not near the middle of images of {size[0]} x {size[1]} pixels, or of a multiple"
        )
    return factor


def read_gaussian_cameras(path: Path) -> list[Shot]:
    """One shot an entry, labelled with `img_name`. `rotation` leads from OpenCV's camera axes to
    the world, `position` is the camera's; the principal point is the center. Raises StgaError."""
    values = read_json(path)
    if not isinstance(values, list):
        raise StgaError(f"{path}: expected a list of cameras")
    return [_gaussian_shot(f"{path}: [{number}]", entry) for number, entry in enumerate(values)]


def _gaussian_shot(where: str, entry: Any) -> Shot:
    if not isinstance(entry, dict):
        raise StgaError(f"{where}: expected an object, not {shorten(entry)}")
    rotation = _array(entry.get("rotation"), where, "rotation", ((3, 3),))
    position = _array(entry.get("position"), where, "position", ((3,),))
    keys = "width", "height", "fx", "fy"
    width, height, fx, fy = (float(_array(entry.get(key), where, key, ((),))) for key in keys)
    # torch's float32 leaves rotations orthonormal to about 1e-6
    center = width / 2, height / 2
    camera: Camera = pinhole((width, height), (fx, fy), center, rotation.T, position, where)
    label = PureWindowsPath(str(entry.get("img_name", entry.get("id", "")))).as_posix()
    return Shot(label, camera, Lens(), where)


def _array(value: Any, where: str, key: str, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray:
    """Finite numbers of one of the shapes. Raises StgaError."""
    try:
        found = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.array(math.nan)
    if found.shape not in shapes or not np.isfinite(found).all():
        expected = " or ".join(" x ".join(map(str, shape)) or "a number" for shape in shapes)
        raise StgaError(f"{where}: {key}: expected {expected}, not {shorten(value)}")
    return found
