"""Cameras of photogrammetry programs: Metashape's XML (File > Export > Export Cameras), and the CSV
of internal and external parameters or the XMP files of RealityCapture and RealityScan."""

import csv
import io
from collections.abc import Callable, Iterable
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ...capture.camera import GL_TO_CV, MAX_FOCAL_PIXELS
from ...errors import StgaError, shorten
from .shots import Lens, Shot, numbers, pinhole, read_text, read_xml

PROJECTIONS = {"frame": "perspective", "fisheye": "fisheye"}  # Metashape's
FILM_WIDTH_MM = 36.0
"""Of the 35 mm film that focal lengths are given for; it stands for the image's longer side."""
REQUIRED_COLUMNS = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
XMP_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")

ImageSize = Callable[[str], tuple[int, int]]
"""Label of a camera -> (width, height), not in RealityCapture's files. Raises StgaError."""


# Metashape


def is_metashape(path: Path) -> bool:
    """Whether it begins as Metashape's export; others write XML files beside images, too."""
    with path.open("rb") as stream:
        start = stream.read(1024)
    return b"<document" in start and b"<chunk" in start


def read_metashape(path: Path) -> tuple[list[Shot], list[str]]:
    """One shot an aligned camera, labelled as in Metashape; and the labels of those that are not
    aligned.

    World and unit are the chunk's, without its transform. Raises StgaError that names file, sensor
    or camera.
    """
    root = read_xml(path)
    sensors = {sensor.get("id"): sensor for sensor in root.iter("sensor")}
    cameras, shots = list(root.iter("camera")), []
    aligned = [camera for camera in cameras if camera.find("transform") is not None]
    components = {camera.get("component_id") for camera in aligned}
    if len(components) > 1:
        parts = f"its cameras are in {len(components)} components"
        raise StgaError(f"{path}: {parts}; expected one alignment of all")
    for camera in aligned:
        label, number = camera.get("label") or "", camera.get("sensor_id")
        where = f"{path}: camera {shorten(label)}"
        if number not in sensors:
            raise StgaError(f"{where}: sensor_id {shorten(number)} is no sensor of the file")
        sensor = f"{path}: sensor {shorten(number)}"
        size, focal, center, lens = _sensor(sensors[number], sensor)
        transform = numbers(camera.findtext("transform", "").split(), f"{where}: transform", 16)
        pose = np.array(transform).reshape(4, 4)  # camera to world, OpenCV axes
        posed = pinhole(size, (focal, focal), center, pose[:3, :3].T, pose[:3, 3], where)
        shots.append(Shot(label, posed, lens, where))
    left_out = (camera for camera in cameras if camera.find("transform") is None)
    return shots, [camera.get("label", "") for camera in left_out]


def _sensor(
    sensor: Element, where: str
) -> tuple[tuple[float, float], float, tuple[float, float], Lens]:
    """Image size, focal length, principal point and lens, adjusted by the alignment or not."""
    found = sensor.findall("calibration")
    adjusted = (c for c in found if c.get("class") == "adjusted")
    calibration = next(adjusted, found[-1] if found else None)
    if calibration is None or calibration.find("f") is None:
        missing = "no calibration with f; align the cameras and export them again"
        raise StgaError(f"{where}: has {missing}")
    kind = calibration.get("type") or sensor.get("type")
    if kind not in PROJECTIONS:
        raise StgaError(f"{where}: type {shorten(kind)} is not one of {', '.join(PROJECTIONS)}")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise StgaError(f"{where}: resolution is missing")
    sides = resolution.get("width", ""), resolution.get("height", "")
    width, height = numbers(sides, f"{where}: resolution")

    def value(name: str) -> float:
        return numbers([calibration.findtext(name, "0")], f"{where}: {name}", 1)[0]

    if value("p3") or value("p4"):
        unknown = "p3 and p4 are not supported"
        raise StgaError(f"{where}: {unknown}; optimize the cameras without them and export again")
    focal = value("f")
    if not 1 <= focal <= MAX_FOCAL_PIXELS:
        raise StgaError(f"{where}: f: expected a focal length of 1 to 1e7 pixels, not {focal:g}")
    lens = Lens(
        PROJECTIONS[kind],
        radial=(value("k1"), value("k2"), value("k3"), value("k4")),
        tangential=(value("p2"), value("p1")),  # Metashape's p1 belongs to x, OpenCV's to y
        affine=(value("b1") / focal, value("b2") / focal),
    )
    return (width, height), focal, (width / 2 + value("cx"), height / 2 + value("cy")), lens


# RealityCapture


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
    lines, rows = csv.reader(io.StringIO(read_text(path))), []
    try:
        rows = [(lines.line_num, line) for line in lines if line]
    except csv.Error as error:
        raise StgaError(f"{path}: line {lines.line_num}: is not readable CSV ({error})") from error
    columns = _columns(rows[0][1]) if rows else []
    missing = [name for name in REQUIRED_COLUMNS if name not in columns]
    if missing:
        expected = "expected internal and external camera parameters"
        raise StgaError(f"{path}: has no column {', '.join(missing)}; {expected}")
    shots = []
    for number, line in rows[1:]:
        where = f"{path}: line {number}"
        if len(line) < len(columns):
            raise StgaError(f"{where}: expected {len(columns)} columns, not {len(line)}")
        row = dict(zip(columns, line, strict=False))
        label = row.pop("name")
        given = {name: text for name, text in row.items() if text or name in REQUIRED_COLUMNS}
        values = {name: numbers([text], f"{where}: {name}", 1)[0] for name, text in given.items()}
        # With all angles zero, the camera looks down and north (y) is up in the image. Heading
        # turns clockwise.
        heading, pitch, roll = (np.deg2rad(values[name]) for name in ("heading", "pitch", "roll"))
        to_world = _turn(2, -heading) @ _turn(0, pitch) @ _turn(1, roll)
        pose = GL_TO_CV[:3, :3] @ to_world.T, np.array([values[name] for name in ("x", "y", "alt")])
        lens = _lens([values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "t1", "t2")])
        focal, center = values["f"] / FILM_WIDTH_MM, (values.get("px", 0.0), values.get("py", 0.0))
        shots.append(_shot(label, image_size(label), (focal, focal), center, *pose, lens, where))
    return shots


def read_realitycapture_xmp(
    paths: Iterable[Path], image_size: ImageSize
) -> tuple[list[Shot], list[str]]:
    """One shot an XMP file with a pose, labelled with its name; and the names of those without.

    Raises StgaError that names file and field.
    """
    shots, without_pose = [], []
    for path in sorted(paths):
        fields: dict[str, str] = {}  # as attributes or as elements, by the version
        for element in read_xml(path).iter():
            named = {**element.attrib, element.tag: element.text or ""}
            own = {key: text for key, text in named.items() if key.startswith(NAMESPACE)}
            fields |= {key.removeprefix(NAMESPACE): text for key, text in own.items()}
        if "Rotation" in fields and "Position" in fields:
            shots.append(_xmp_shot(path, fields, image_size(path.stem)))
        else:
            without_pose.append(path.stem)
    return shots, without_pose


def _columns(names: Iterable[str]) -> list[str]:
    return [name.strip().lstrip("#").lower() for name in names]


def _turn(axis: int, angle: float) -> np.ndarray:
    """Rotation (3, 3) by `angle` radians about axis 0, 1 or 2."""
    cos, sin = np.cos(angle), np.sin(angle)
    about_x = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    return np.roll(about_x, (axis, axis), (0, 1))


def _xmp_shot(path: Path, fields: dict[str, str], size: tuple[int, int]) -> Shot:
    where = str(path)

    def values(name: str, default: str, count: int | None = 1) -> list[float]:
        return numbers(fields.get(name, default).split(), f"{where}: xcr:{name}", count)

    coefficients = values("DistortionCoeficients", "0", None)  # so spelled
    coefficients += [0.0] * (6 - len(coefficients))
    model = fields.get("DistortionModel", "perspective")
    if model not in XMP_MODELS and any(coefficients):
        raise StgaError(
            f"{where}: xcr:DistortionModel {shorten(model)} is not one of {', '.join(XMP_MODELS)}; "
            "choose one of these in RealityCapture's alignment settings and export again"
        )
    if "FocalLength35mm" not in fields:
        raise StgaError(f"{where}: xcr:FocalLength35mm is missing")
    focal = values("FocalLength35mm", "")[0] / FILM_WIDTH_MM
    lens = _lens(coefficients, skew=values("Skew", "0")[0] / focal if focal else 0.0)
    rotation = np.array(values("Rotation", "", 9)).reshape(3, 3)  # world to camera, OpenCV axes
    center = values("PrincipalPointU", "0")[0], values("PrincipalPointV", "0")[0]
    focals = focal, focal * values("AspectRatio", "1")[0]
    position = np.array(values("Position", "", 3))
    return _shot(path.stem, size, focals, center, rotation, position, lens, where)


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
    focals = focal[0] * scale, focal[1] * scale
    return Shot(label, pinhole(size, focals, principal, rotation, position, where), lens, where)
