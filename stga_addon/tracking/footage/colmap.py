"""Cameras of a COLMAP model: `cameras` and `images`, as .bin or .txt."""

import math
import os
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from ...capture.lens import Lens
from ...errors import StgaError, shorten
from ...files import is_file, read_bytes, read_text
from ...flame.quaternions import to_matrices
from .shots import Calibrated, Shot, numbers, pinhole
from .sources import natural_order

_Camera = tuple[int, tuple[str, tuple[int, int], Sequence[float]]]
"""Number; model, size and parameters."""
_Image = tuple[str, Sequence[float], int]
"""Name, quaternion wxyz with translation from world to camera, and number of the camera."""
LENSES: dict[str, tuple[int, int, int, Callable[..., Lens]]] = {
    "SIMPLE_PINHOLE": (0, 1, 0, Lens),
    "PINHOLE": (1, 2, 0, Lens),
    "SIMPLE_RADIAL": (2, 1, 1, lambda k: Lens(radial=(k,))),
    "RADIAL": (3, 1, 2, lambda *k: Lens(radial=k)),
    "OPENCV": (4, 2, 4, lambda k1, k2, *p: Lens(radial=(k1, k2), tangential=p)),
    "OPENCV_FISHEYE": (5, 2, 4, lambda *k: Lens("fisheye", radial=k)),
    "FULL_OPENCV": (
        6,
        2,
        8,
        lambda k1, k2, p1, p2, k3, *k: Lens(radial=(k1, k2, k3), rational=k, tangential=(p1, p2)),
    ),
    "FOV": (7, 2, 1, lambda omega: Lens("field of view", parameter=omega)),
    "SIMPLE_RADIAL_FISHEYE": (8, 1, 1, lambda k: Lens("fisheye", radial=(k,))),
    "RADIAL_FISHEYE": (9, 1, 2, lambda *k: Lens("fisheye", radial=k)),
    "THIN_PRISM_FISHEYE": (
        10,
        2,
        8,
        lambda k1, k2, p1, p2, k3, k4, sx1, sy1: Lens(
            "fisheye", radial=(k1, k2, k3, k4), tangential=(p1, p2), prism=(sx1, 0.0, sy1, 0.0)
        ),
    ),
    "SIMPLE_DIVISION": (12, 1, 1, lambda k: Lens("division", parameter=k)),
    "DIVISION": (13, 2, 1, lambda k: Lens("division", parameter=k)),
    "SIMPLE_FISHEYE": (14, 1, 0, lambda: Lens("fisheye")),
    "FISHEYE": (15, 2, 0, lambda: Lens("fisheye")),
}
"""Model -> its number in binary files, numbers of its focal lengths (of both axes, or of each) and
of its distortion coefficients, and the lens that these make."""

KNOWN_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap")
POSE_WORDS = 9  # Words of an image's line before its name
POINT_WORDS = 3  # Words of a point: x, y and its number


def colmap_models(folder: Path) -> list[Path]:
    """Folders of models in one of footage, itself and down to three levels below, in the order in
    which they are to be tried: those of most images first, then `KNOWN_FOLDERS`, and last those
    below `distorted`, where 3DGS's convert.py keeps the model of the images before undistortion."""
    found = []
    for path, names, _ in os.walk(folder):
        below = Path(path).relative_to(folder)
        names[:] = sorted(n for n in names if not n.startswith(".") and len(below.parts) < 3)
        if model_suffix(Path(path)):
            found.append(below)
    counts = {model: _image_count(folder / model) if len(found) > 1 else 0 for model in found}

    def order(model: Path) -> tuple[bool, int, int, list[tuple[int, str]]]:
        name = model.as_posix()
        known_folder = next((n for n, known in enumerate(KNOWN_FOLDERS) if name == known), None)
        rank = len(KNOWN_FOLDERS) if known_folder is None else known_folder
        return is_distorted(model), -counts[model], rank, natural_order(name)

    return [folder / model for model in sorted(found, key=order)]


def incomplete_models(folder: Path) -> list[Path]:
    """Folders of one of footage that hold one of the two files of a model, as text or binary."""
    folders = sorted({folder, *folder.glob("sparse"), *folder.glob("sparse/*")})
    names = [f"{name}{suffix}" for name in ("cameras", "images") for suffix in (".bin", ".txt")]
    damaged = (model for model in folders if not model_suffix(model))
    return [model / name for model in damaged for name in names if is_file(model / name)]


def is_distorted(folder: Path) -> bool:
    """Whether a model is of the images before undistortion, by 3DGS's names of folders."""
    return "distorted" in folder.parts


def _image_count(folder: Path) -> int:
    """Number of images of a model; 0 for one that is damaged, which is refused when it is read."""
    with suppress(StgaError):
        if model_suffix(folder) == ".bin":
            return int(_Cursor(folder / "images.bin").unpack("Q")[0])
        return sum(1 for _ in _text_images(folder / "images.txt"))
    return 0


def read_colmap(folder: Path) -> Calibrated:
    """One shot an image, in natural order of their names, which are the labels; COLMAP's numbers
    vary from run to run. World and unit are the model's. Raises StgaError that names file, camera
    and image."""
    suffix = model_suffix(folder)
    if suffix is None:
        expected = "expected cameras.bin and images.bin, or .txt"
        raise StgaError(f"{folder}: is no COLMAP model; {expected}")
    cameras_file = folder / f"cameras{suffix}"
    images_file = folder / f"images{suffix}"
    text = _text_cameras, _text_images
    read_cameras, read_images = text if suffix == ".txt" else (_binary_cameras, _binary_images)
    cameras = dict(read_cameras(cameras_file))
    images = read_images(images_file)
    shots = []
    for name, pose, camera in sorted(images, key=lambda image: natural_order(image[0])):
        where = f"{images_file}: image {shorten(name)}"
        if camera not in cameras:
            raise StgaError(f"{where}: names camera {camera}, which {cameras_file} does not have")
        model, size, values = cameras[camera]
        if model not in LENSES:
            raise StgaError(
                f"{cameras_file}: camera {camera}: model {shorten(model)} is not one of "
                f"{', '.join(LENSES)}"
            )
        _, focals, count, lens = LENSES[model]
        if len(values) != focals + 2 + count:
            expected = f"expected {focals + 2 + count} parameters of {model}, not {len(values)}"
            raise StgaError(f"{cameras_file}: camera {camera}: {expected}")
        *focal, cx, cy = values[: focals + 2]
        length = math.hypot(*pose[:4])
        if not 0.5 < length < 2:
            raise StgaError(f"{where}: expected a rotation quaternion of length 1, not {length:g}")
        rotation = to_matrices(np.array(pose[:4]))
        with np.errstate(over="ignore", invalid="ignore"):  # `pinhole` refuses what is not finite
            position = -rotation.T @ np.array(pose[4:])
        posed = pinhole(size, (focal[0], focal[-1]), (cx, cy), rotation, position, where)
        shots.append(Shot(name, posed, lens(*values[focals + 2 :]), where))
    return shots, ()


def model_suffix(folder: Path) -> str | None:
    """.bin or .txt, of a folder that is a model; None for others."""
    for suffix in (".bin", ".txt"):
        if all(is_file(folder / f"{name}{suffix}") for name in ("cameras", "images")):
            return suffix
    return None


# Text


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number from 1, line) without comments; images.txt has empty ones of no points."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def _text_cameras(path: Path) -> Iterator[_Camera]:
    """Lines `number model width height parameters…`."""
    for number, line in _lines(path):
        words = line.split()
        where = f"{path}: line {number}"
        if not words:
            continue
        if len(words) < 5:
            raise StgaError(
                f"{where}: expected number, model, width, height and parameters of a camera"
            )
        identity, width, height = (_whole(word, where) for word in (words[0], *words[2:4]))
        yield identity, (words[1], (width, height), numbers(words[4:], where))


def _text_images(path: Path) -> Iterator[_Image]:
    """A line an image, `number qw qx qy qz tx ty tz camera name`, and the line of its points, which
    some programs leave out."""
    points_may_follow = False
    for number, line in _lines(path):
        words = line.split(maxsplit=POSE_WORDS)
        where = f"{path}: line {number}"
        has_points = _is_of_points(line)
        if not words or (points_may_follow and has_points):
            points_may_follow = False
            continue
        if len(words) <= POSE_WORDS or has_points:
            expected = "number, quaternion, translation, camera and name of an image"
            points = f", or its points by {POINT_WORDS} numbers each" * points_may_follow
            raise StgaError(f"{where}: expected {expected}{points}")
        yield words[POSE_WORDS], numbers(words[1:8], where, 7), _whole(words[8], where)
        points_may_follow = True


def _is_of_points(line: str) -> bool:
    """Whether a line has three numbers a point, by its first points and the number of its words."""
    words = line.split()
    if len(words) % POINT_WORDS:
        return False
    try:
        return all(math.isfinite(float(word)) for word in words[: 4 * POINT_WORDS])
    except ValueError:
        return False


def _whole(word: str, where: str) -> int:
    if not word.isdecimal() or len(word) > 18:
        raise StgaError(f"{where}: expected a whole number, not {shorten(word)}")
    return int(word)


# Binary


class _Cursor:
    """Position in the bytes of a file; reads little-endian values one after another."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path)
        self.offset = 0

    def unpack(self, layout: str) -> tuple[float, ...]:
        start = self.offset
        self.advance(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.data, start)

    def advance(self, size: int) -> None:
        if size > len(self.data) - self.offset:
            raise StgaError(f"{self.path}: ends within an entry; expected a COLMAP model")
        self.offset += size

    def name(self) -> str:
        start = self.offset
        end = self.data.find(b"\0", self.offset)
        self.advance((end if end >= 0 else len(self.data)) + 1 - start)
        name = self.data[start:end]
        return name.decode("utf-8", errors="replace")  # where it is not, no image has that name


def _binary_cameras(path: Path) -> Iterator[_Camera]:
    cursor = _Cursor(path)
    names = {number: name for name, (number, *_) in LENSES.items()}
    for _ in range(int(cursor.unpack("Q")[0])):
        identity, model, width, height = (int(value) for value in cursor.unpack("IiQQ"))
        if model not in names:
            known = ", ".join(LENSES)
            raise StgaError(f"{path}: camera {identity}: model {model} is not one of {known}")
        _, focals, count, _ = LENSES[names[model]]
        yield identity, (names[model], (width, height), cursor.unpack(f"{focals + 2 + count}d"))


def _binary_images(path: Path) -> Iterator[_Image]:
    cursor = _Cursor(path)
    for _ in range(int(cursor.unpack("Q")[0])):
        _number, *pose, camera = cursor.unpack("I7dI")
        yield cursor.name(), pose, int(camera)
        cursor.advance(24 * int(cursor.unpack("Q")[0]))  # x, y and number of each point
