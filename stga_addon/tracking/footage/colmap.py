"""Cameras of a COLMAP model: `cameras` and `images`, as .bin or .txt."""

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import StgaError, shorten
from ...files import read_bytes
from ...flame.quaternions import to_matrices
from .lens import Lens
from .reading import numbers, pinhole, read_text
from .shots import Shot
from .sources import natural_order

MODEL_NAMES = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
)
"""By their number in binary files."""
SHARED_FOCAL = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_DIVISION",
    "SIMPLE_FISHEYE",
)
"""One focal length for both axes; the others begin with fx, fy."""
LENSES: dict[str, tuple[int, Callable[..., Lens]]] = {
    "SIMPLE_PINHOLE": (0, Lens),
    "PINHOLE": (0, Lens),
    "SIMPLE_RADIAL": (1, lambda k: Lens(radial=(k,))),
    "RADIAL": (2, lambda k1, k2: Lens(radial=(k1, k2))),
    "OPENCV": (4, lambda k1, k2, p1, p2: Lens(radial=(k1, k2), tangential=(p1, p2))),
    "OPENCV_FISHEYE": (4, lambda *k: Lens("fisheye", radial=k)),
    "FULL_OPENCV": (
        8,
        lambda k1, k2, p1, p2, k3, k4, k5, k6: Lens(
            radial=(k1, k2, k3), rational=(k4, k5, k6), tangential=(p1, p2)
        ),
    ),
    "FOV": (1, lambda omega: Lens("field of view", parameter=omega)),
    "SIMPLE_RADIAL_FISHEYE": (1, lambda k: Lens("fisheye", radial=(k,))),
    "RADIAL_FISHEYE": (2, lambda k1, k2: Lens("fisheye", radial=(k1, k2))),
    "THIN_PRISM_FISHEYE": (
        8,
        lambda k1, k2, p1, p2, k3, k4, sx1, sy1: Lens(
            "fisheye", radial=(k1, k2, k3, k4), tangential=(p1, p2), prism=(sx1, 0.0, sy1, 0.0)
        ),
    ),
    "SIMPLE_DIVISION": (1, lambda k: Lens("division", parameter=k)),
    "DIVISION": (1, lambda k: Lens("division", parameter=k)),
    "SIMPLE_FISHEYE": (0, lambda: Lens("fisheye")),
    "FISHEYE": (0, lambda: Lens("fisheye")),
}
"""Model -> number of its distortion coefficients, and the lens that they make."""


@dataclass(frozen=True)
class _Intrinsics:
    model: str
    size: tuple[int, int]
    values: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


def find_colmap(folder: Path) -> Path | None:
    """The folder of a model in one of footage: itself, or COLMAP's usual `sparse/0`."""
    usual = ("", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap")
    return next((folder / name for name in usual if _suffix(folder / name)), None)


def read_colmap(folder: Path) -> list[Shot]:
    """One shot an image, in natural order of their names, which are the labels; COLMAP's numbers
    vary from run to run.

    World and unit are the model's. Raises StgaError that names file, camera and image.
    """
    suffix = _suffix(folder)
    if suffix is None:
        raise StgaError(
            f"{folder}: is no COLMAP model; expected cameras.bin and images.bin, or .txt"
        )
    cameras_file, images_file = folder / f"cameras{suffix}", folder / f"images{suffix}"
    cameras = (_binary_cameras if suffix == ".bin" else _text_cameras)(cameras_file)
    images = sorted(
        (_binary_images if suffix == ".bin" else _text_images)(images_file),
        key=lambda image: natural_order(image.name),
    )
    return [_shot(image, cameras, cameras_file, images_file) for image in images]


def _suffix(folder: Path) -> str | None:
    complete = (
        s
        for s in (".bin", ".txt")
        if (folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file()
    )
    return next(complete, None)


def _shot(
    image: _Image, cameras: dict[int, _Intrinsics], cameras_file: Path, images_file: Path
) -> Shot:
    where = f"{images_file}: image {shorten(image.name)}"
    if image.camera not in cameras:
        raise StgaError(f"{where}: names camera {image.camera}, which {cameras_file} does not have")
    intrinsics = cameras[image.camera]
    focal, center, lens = _split(intrinsics, f"{cameras_file}: camera {image.camera}")
    rotation = _rotation(np.array(image.quaternion), where)
    with np.errstate(over="ignore", invalid="ignore"):  # `pinhole` refuses what is not finite
        position = -rotation.T @ np.array(image.translation)
    return Shot(
        image.name, pinhole(intrinsics.size, focal, center, rotation, position, where), lens, where
    )


def _split(
    intrinsics: _Intrinsics, where: str
) -> tuple[tuple[float, float], tuple[float, float], Lens]:
    """Focal lengths, principal point and lens of a model's parameters."""
    if intrinsics.model not in LENSES:
        raise StgaError(
            f"{where}: model {shorten(intrinsics.model)} is not one of {', '.join(LENSES)}"
        )
    count, lens = LENSES[intrinsics.model]
    focals = 1 if intrinsics.model in SHARED_FOCAL else 2
    if len(intrinsics.values) != focals + 2 + count:
        found = len(intrinsics.values)
        raise StgaError(
            f"{where}: expected {focals + 2 + count} parameters of {intrinsics.model}, not {found}"
        )
    *focal, cx, cy = intrinsics.values[: focals + 2]
    return (focal[0], focal[-1]), (cx, cy), lens(*intrinsics.values[focals + 2 :])


def _rotation(quaternion: np.ndarray, where: str) -> np.ndarray:
    """World to camera, from a quaternion wxyz."""
    length = math.hypot(*quaternion)
    if not 0.5 < length < 2:
        raise StgaError(f"{where}: expected a rotation quaternion of length 1, not {length:g}")
    return to_matrices(quaternion)


# Text


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number from 1, line) without comments; empty lines stay: images.txt has one for an image
    without points."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def _text_cameras(path: Path) -> dict[int, _Intrinsics]:
    """Lines `number model width height parameters…`."""
    cameras = {}
    for number, line in _lines(path):
        words, where = line.split(), f"{path}: line {number}"
        if not words:
            continue
        if len(words) < 5:
            raise StgaError(
                f"{where}: expected number, model, width, height and parameters of a camera"
            )
        identity, width, height = (_whole(word, where) for word in (words[0], *words[2:4]))
        cameras[identity] = _Intrinsics(words[1], (width, height), tuple(numbers(words[4:], where)))
    return cameras


def _text_images(path: Path) -> Iterator[_Image]:
    """Two lines an image: `number qw qx qy qz tx ty tz camera name`, then its points."""
    lines = _lines(path)
    for number, line in lines:
        words, where = line.split(maxsplit=9), f"{path}: line {number}"
        if not words:
            continue
        if len(words) < 10:
            raise StgaError(
                f"{where}: expected number, quaternion, translation, camera and name of an image"
            )
        pose = numbers(words[1:8], where, 7)
        yield _Image(tuple(pose[:4]), tuple(pose[4:]), _whole(words[8], where), words[9])
        next(lines, None)


def _whole(word: str, where: str) -> int:
    if not word.isdecimal() or len(word) > 18:
        raise StgaError(f"{where}: expected a whole number, not {shorten(word)}")
    return int(word)


# Binary


class _Cursor:
    """Position in the bytes of a file; reads little-endian values one after another."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.offset = path, read_bytes(path), 0

    def unpack(self, layout: str) -> tuple[float, ...]:
        try:
            values = struct.unpack_from("<" + layout, self.data, self.offset)
        except struct.error as error:
            raise StgaError(
                f"{self.path}: ends within an entry; expected a COLMAP model"
            ) from error
        self.offset += struct.calcsize("<" + layout)
        return values

    def count(self) -> int:
        return int(self.unpack("Q")[0])

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.offset:
            raise StgaError(f"{self.path}: ends within an entry; expected a COLMAP model")
        self.offset += size

    def name(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise StgaError(f"{self.path}: ends within a name; expected a COLMAP model")
        name, self.offset = self.data[self.offset : end], end + 1
        try:
            return name.decode("utf-8")
        except ValueError as error:
            raise StgaError(f"{self.path}: image name {name!r} is not UTF-8") from error


def _binary_cameras(path: Path) -> dict[int, _Intrinsics]:
    cursor, cameras = _Cursor(path), {}
    for _ in range(cursor.count()):
        identity, model, width, height = (int(value) for value in cursor.unpack("IiQQ"))
        if not 0 <= model < len(MODEL_NAMES) or MODEL_NAMES[model] not in LENSES:
            raise StgaError(
                f"{path}: camera {identity}: model {model} is not one of {', '.join(LENSES)}"
            )
        name = MODEL_NAMES[model]
        values = cursor.unpack(f"{(1 if name in SHARED_FOCAL else 2) + 2 + LENSES[name][0]}d")
        cameras[identity] = _Intrinsics(name, (width, height), values)
    return cameras


def _binary_images(path: Path) -> Iterator[_Image]:
    cursor = _Cursor(path)
    for _ in range(cursor.count()):
        _, *pose, camera = cursor.unpack("I7dI")
        name = cursor.name()
        yield _Image(tuple(pose[:4]), tuple(pose[4:]), int(camera), name)
        cursor.skip(24 * cursor.count())  # x, y and number of each point
