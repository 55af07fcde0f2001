"""Cameras of RealityCapture and RealityScan: the CSV of internal and external parameters, or an XMP
file an image."""

import csv
import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from ...capture.camera import GL_TO_CV
from ...errors import StgaError, shorten
from .lens import Lens
from .reading import numbers, pinhole, read_text, read_xml
from .shots import Shot

FILM_WIDTH_MM = 36.0
"""Of the 35 mm film that focal lengths are given for; it stands for the image's longer side."""
REQUIRED_COLUMNS = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
XMP_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")

ImageSize = Callable[[str], tuple[int, int]]
"""Label of a camera -> (width, height) of its images, which neither file holds. Raises
StgaError."""


def is_realitycapture_csv(path: Path) -> bool:
    """Whether the first line is that of an export of internal and external camera parameters."""
    with path.open("rb") as stream:
        names = stream.readline(4096).decode("utf-8-sig", errors="replace")
    return set(REQUIRED_COLUMNS) <= set(_columns(names.split(",")))


def read_realitycapture_csv(path: Path, image_size: ImageSize) -> list[Shot]:
    """One shot a line, labelled with the image's name.

    Columns: name, x, y, alt, heading, pitch, roll (degrees), f (35 mm film), and, where they are
    there, px, py (shares of the longer side), k1 to k4, t1, t2. Raises StgaError that names file
    and line.
    """
    rows = _csv_rows(path)
    columns = _columns(next(rows, (1, []))[1])
    missing = [name for name in REQUIRED_COLUMNS if name not in columns]
    if missing:
        raise StgaError(
            f"{path}: has no column {', '.join(missing)}; expected internal and external camera parameters"
        )
    shots = []
    for number, line in rows:
        where = f"{path}: line {number}"
        if len(line) < len(columns):
            raise StgaError(f"{where}: expected {len(columns)} columns, not {len(line)}")
        row = dict(zip(columns, line, strict=False))
        label = row.pop("name")
        given = {name: text for name, text in row.items() if text or name in REQUIRED_COLUMNS}
        values = {name: numbers([text], f"{where}: {name}", 1)[0] for name, text in given.items()}
        shots.append(_csv_shot(label, values, image_size(label), where))
    return shots


def read_realitycapture_xmp(
    paths: Iterable[Path], image_size: ImageSize
) -> tuple[list[Shot], list[str]]:
    """One shot an XMP file with a pose, labelled with its name; and the names of those without.

    Raises StgaError that names file and field.
    """
    shots, without_pose = [], []
    for path in sorted(paths):
        fields = _xmp_fields(path)
        if "Rotation" in fields and "Position" in fields:
            shots.append(_xmp_shot(path, fields, image_size(path.stem)))
        else:
            without_pose.append(path.stem)
    return shots, without_pose


def _csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number from 1 and values of each line that is not empty."""
    lines = csv.reader(io.StringIO(read_text(path)))
    try:
        for line in lines:
            if line:
                yield lines.line_num, line
    except csv.Error as error:
        raise StgaError(f"{path}: line {lines.line_num}: is not readable CSV ({error})") from error


def _columns(names: Iterable[str]) -> list[str]:
    return [name.strip().lstrip("#").lower() for name in names]


def _csv_shot(label: str, values: dict[str, float], size: tuple[int, int], where: str) -> Shot:
    heading, pitch, roll = (np.deg2rad(values[name]) for name in ("heading", "pitch", "roll"))
    # With all angles zero, the camera looks down and north (y) is up in the image. Heading turns
    # clockwise.
    to_world = _turn(2, -heading) @ _turn(0, pitch) @ _turn(1, roll)
    rotation = GL_TO_CV[:3, :3] @ to_world.T
    position = np.array([values[name] for name in ("x", "y", "alt")])
    coefficients = [values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "t1", "t2")]
    focal, center = values["f"] / FILM_WIDTH_MM, (values.get("px", 0.0), values.get("py", 0.0))
    return _shot(
        label, size, (focal, focal), center, rotation, position, _lens(coefficients), where
    )


def _turn(axis: int, angle: float) -> np.ndarray:
    """Rotation (3, 3) by `angle` radians about axis 0, 1 or 2."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[second, first], matrix[first, second] = np.sin(angle), -np.sin(angle)
    return matrix


def _xmp_fields(path: Path) -> dict[str, str]:
    """Fields of RealityCapture, which versions of it write as attributes or as elements."""
    fields = {}
    for element in read_xml(path).iter():
        named = {**element.attrib, element.tag: element.text or ""}
        fields.update(
            {k.removeprefix(NAMESPACE): v for k, v in named.items() if k.startswith(NAMESPACE)}
        )
    return fields


def _xmp_shot(path: Path, fields: dict[str, str], size: tuple[int, int]) -> Shot:
    where = str(path)

    def values(name: str, default: str, count: int | None = 1) -> list[float]:
        return numbers(fields.get(name, default).split(), f"{where}: xcr:{name}", count)

    coefficients = values("DistortionCoeficients", "0", None)  # so spelled
    coefficients += [0.0] * (6 - len(coefficients))
    model = fields.get("DistortionModel", "perspective")
    if model not in XMP_MODELS and any(coefficients):
        raise StgaError(
            f"{where}: xcr:DistortionModel {shorten(model)} is not one of {', '.join(XMP_MODELS)}; choose one of these "
            "in RealityCapture's alignment settings and export again"
        )
    if "FocalLength35mm" not in fields:
        raise StgaError(f"{where}: xcr:FocalLength35mm is missing")
    focal = values("FocalLength35mm", "")[0] / FILM_WIDTH_MM
    lens = _lens(coefficients, skew=values("Skew", "0")[0] / focal if focal else 0.0)
    rotation = np.array(values("Rotation", "", 9)).reshape(3, 3)  # world to camera, OpenCV axes
    center = values("PrincipalPointU", "0")[0], values("PrincipalPointV", "0")[0]
    focals = focal, focal * values("AspectRatio", "1")[0]
    return _shot(
        path.stem, size, focals, center, rotation, np.array(values("Position", "", 3)), lens, where
    )


def _lens(coefficients: list[float], skew: float = 0.0) -> Lens:
    """coefficients: k1 to k4, t1, t2; RealityCapture's t1 belongs to x, OpenCV's p1 to y."""
    k1, k2, k3, k4, t1, t2 = coefficients[:6]
    return Lens(radial=(k1, k2, k3, k4), tangential=(t2, t1), affine=(0.0, skew))


def _shot(
    label: str,
    size: tuple[int, int],
    focal: tuple[float, float],
    center: tuple[float, float],
    rotation: np.ndarray,
    position: np.ndarray,
    lens: Lens,
    where: str,
) -> Shot:
    """focal, and center from the middle of the image, are shares of the image's longer side."""
    scale = max(size)
    principal = size[0] / 2 + center[0] * scale, size[1] / 2 + center[1] * scale
    camera = pinhole(
        size, (focal[0] * scale, focal[1] * scale), principal, rotation, position, where
    )
    return Shot(label, camera, lens, where)
