"""Which calibration a footage folder has, and its cameras: of nerfstudio, instant-ngp and VHAP
(`transforms.json`, with lens distortion), Metashape's XML (File > Export > Export Cameras), the CSV
of internal and external parameters or the XMP files of RealityCapture and RealityScan; and COLMAP,
which `colmap` reads."""

import csv
import io
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ...capture.camera import GL_TO_CV, MAX_FOCAL_PIXELS
from ...capture.model import FPS_LIMIT
from ...capture.transforms import (
    WHOLE_FILE,
    Record,
    read_transforms,
    transforms_files,
    with_principal_point,
)
from ...errors import StgaError, shorten
from ...files import is_file, is_folder, matching
from ...flame.forward import axis_angle_matrices
from .colmap import find_colmap, read_colmap
from .shots import Lens, Shot, numbers, pinhole, read_text, read_xml

EXPECTED = (
    "transforms.json, a COLMAP model (sparse/0), Metashape's cameras.xml, "
    "RealityCapture's CSV or XMP files"
)
NAMES_IN_WARNING = 5
PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
PERSPECTIVE_MODELS = (*PINHOLE_MODELS, "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
PROJECTIONS = {"frame": "perspective", "fisheye": "fisheye"}  # Metashape's
FILM_WIDTH_MM = 36.0
"""Of the 35 mm film that focal lengths are given for; it stands for the image's longer side."""
REQUIRED_COLUMNS = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
XMP_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")

Pair = tuple[float, float]
Found = tuple[list[Shot], list[str]]  # Cameras with a pose, and labels of those without
ImageSize = Callable[[str], tuple[int, int]]
"""Label of a camera -> (width, height), not in RealityCapture's files. Raises StgaError."""


def find_calibration(root: Path) -> Path | None:
    """The calibration of a folder, the first of: transforms files, COLMAP, Metashape,
    RealityCapture's CSV and XMP. A folder stands for transforms_train.json and its like, for a
    COLMAP model or for XMP files."""
    listed = transforms_files(root)
    if listed:
        return listed[0] if listed[0].name == WHOLE_FILE else root
    colmap = find_colmap(root)
    if colmap is not None:
        return colmap
    found = [path for path in matching(root, "*.xml") if is_file(path) and _is_metashape(path)]
    found += [path for path in matching(root, "*.csv") if is_file(path) and _is_csv(path)]
    if len(found) > 1:
        raise StgaError(f"{root}: {found[0].name} and {found[1].name} are calibrations; choose one")
    folders = [folder for folder in (root, root / "images") if matching(folder, "*.xmp")]
    return next(iter(found + folders), None)


def read_calibration(path: Path, image_size: ImageSize) -> tuple[list[Shot], tuple[str, ...]]:
    """Shots of a calibration file or folder, and a sentence about cameras that it lists without a
    pose. image_size: size of the images of a label, which RealityCapture does not write. Raises
    StgaError that names file and field."""
    suffix = path.suffix.lower()
    without_pose = list[str]()
    if is_folder(path) and (splits := transforms_files(path)):
        shots = [shot for name in splits for shot in read_nerfstudio(name)]
    elif is_folder(path) and (colmap := find_colmap(path)):
        shots = read_colmap(colmap)
    elif is_folder(path):
        shots, without_pose = read_realitycapture_xmp(matching(path, "*.xmp"), image_size)
    elif not is_file(path):
        raise StgaError(f"{path}: does not exist; expected {EXPECTED}")
    elif suffix in (".bin", ".txt") and find_colmap(path.parent) == path.parent:
        shots = read_colmap(path.parent)
    elif suffix == ".json":
        shots = read_nerfstudio(path)
    elif suffix == ".xml":
        shots, without_pose = read_metashape(path)
    elif suffix == ".csv":
        shots = read_realitycapture_csv(path, image_size)
    elif suffix == ".xmp":
        shots, without_pose = read_realitycapture_xmp([path], image_size)
    else:
        raise StgaError(f"{path}: is no calibration; expected {EXPECTED}")
    if not shots:
        raise StgaError(f"{path}: has no camera with a pose")
    if not without_pose:
        return shots, ()
    names = ", ".join(without_pose[:NAMES_IN_WARNING])
    more = len(without_pose) - NAMES_IN_WARNING
    rest = f" and {more} more" if more > 0 else ""
    return shots, (f"{path}: left out cameras without a pose: {names}{rest}",)


# Transforms files


def read_nerfstudio(path: Path) -> list[Shot]:
    """Entries of a transforms file; `file_path` is the label. Raises StgaError. Their `cy` means
    what VHAP's does where frames have `timestep_index` and nothing says which lens they have, as
    nerfstudio's and instant-ngp's do, else what OpenCV's does (`read_transforms`)."""
    frames = read_transforms(path, "opencv")
    shots = []
    is_timed = any(
        frame.record.has(key) for frame in frames for key in ("timestep_index", "keyframe")
    )
    has_lens = any(frame.record.has(key) for frame in frames for key in ("camera_model", "k1"))
    is_vhap = not has_lens and any(frame.record.has("timestep_index") for frame in frames)
    for frame in frames:
        view = frame.view
        record = frame.record
        name = frame.camera_id
        camera = with_principal_point(view.camera, frame.principal, "vhap" if is_vhap else "opencv")
        if name is None and record.has("camera_index"):
            name = f"{view.camera_index:02d}"
        timestep = view.timestep if is_timed else None
        mask = view.mask
        mask = mask or record.path_of("mask_path")  # nerfstudio's
        fps = record.number("fps", 0, FPS_LIMIT) if record.has("fps") else None
        keeps_world = record.values.get("world") == "keep"
        shot = Shot(view.name, camera, _lens(record), frame.where, view.image, timestep, mask, name)
        shots.append(replace(shot, fps=fps, keeps_world=keeps_world))
    return shots


def _lens(record: Record) -> Lens:
    """The lens of a frame."""
    usual = "OPENCV_FISHEYE" if record.values.get("is_fisheye") else "OPENCV"
    model = record.values.get("camera_model") or usual
    known = PERSPECTIVE_MODELS + FISHEYE_MODELS
    if model not in known:
        one = f"{shorten(model)} is not one of {', '.join(known)}"
        raise StgaError(f"{record.where('camera_model')}: {one}")
    if model in PINHOLE_MODELS:
        return Lens()
    names = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    *k, p1, p2 = (record.number(name) if record.has(name) else 0.0 for name in names)
    if model in FISHEYE_MODELS:
        return Lens("fisheye", radial=tuple(k[:4]))
    if model == "FULL_OPENCV":
        return Lens(radial=tuple(k[:3]), rational=tuple(k[3:]), tangential=(p1, p2))
    return Lens(radial=tuple(k[:4]), tangential=(p1, p2))  # nerfstudio's k4 is that of r⁸


# Metashape


def _is_metashape(path: Path) -> bool:
    """Whether it begins as Metashape's export; others write XML files beside images, too."""
    with path.open("rb") as stream:
        start = stream.read(1024)
    return b"<document" in start and b"<chunk" in start


def read_metashape(path: Path) -> Found:
    """One shot an aligned camera, labelled as in Metashape; and the labels of those that are not
    aligned. World and unit are the chunk's, without its transform. Raises StgaError that names
    file, sensor or camera."""
    root = read_xml(path)
    sensors = {sensor.get("id"): sensor for sensor in root.iter("sensor")}
    cameras = list(root.iter("camera"))
    shots = []
    aligned = [camera for camera in cameras if camera.find("transform") is not None]
    components = {camera.get("component_id") for camera in aligned}
    if len(components) > 1:
        parts = f"its cameras are in {len(components)} components"
        raise StgaError(f"{path}: {parts}; expected one alignment of all")
    for camera in aligned:
        label = camera.get("label") or ""
        number = camera.get("sensor_id")
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


def _sensor(sensor: Element, where: str) -> tuple[Pair, float, Pair, Lens]:
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


def _is_csv(path: Path) -> bool:
    """Whether the first line is that of an export of internal and external camera parameters."""
    with path.open("rb") as stream:
        names = stream.readline(4096).decode("utf-8-sig", errors="replace")
    return set(REQUIRED_COLUMNS) <= set(_columns(names.split(",")))


def read_realitycapture_csv(path: Path, image_size: ImageSize) -> list[Shot]:
    """One shot a line, labelled with the image's name. Columns: name, x, y, alt, heading, pitch,
    roll (degrees), f (35 mm film), and, where they are there, px, py (shares of the longer side),
    k1 to k4, t1, t2. Raises StgaError that names file and line."""
    lines = csv.reader(io.StringIO(read_text(path)))
    rows = []
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
        turns = axis_angle_matrices(np.array([[0, 0, -heading], [pitch, 0, 0], [0, roll, 0]]))
        rotation = GL_TO_CV[:3, :3] @ (turns[0] @ turns[1] @ turns[2]).T
        position = np.array([values[name] for name in ("x", "y", "alt")])
        size = image_size(label)
        scale = max(image_size(label))
        focal = values["f"] / FILM_WIDTH_MM * scale
        cx, cy = (values.get(name, 0.0) * scale for name in ("px", "py"))
        center = size[0] / 2 + cx, size[1] / 2 + cy
        camera = pinhole(size, (focal, focal), center, rotation, position, where)
        coefficients = [values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "t1", "t2")]
        shots.append(Shot(label, camera, _realitycapture_lens(coefficients), where))
    return shots


def read_realitycapture_xmp(paths: Iterable[Path], image_size: ImageSize) -> Found:
    """One shot an XMP file with a pose, labelled with its name; and the names of those without.
    Raises StgaError that names file and field."""
    shots = []
    without_pose = []
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


def _xmp_shot(path: Path, fields: dict[str, str], size: tuple[int, int]) -> Shot:
    def values(name: str, default: str, count: int | None = 1) -> list[float]:
        return numbers(fields.get(name, default).split(), f"{path}: xcr:{name}", count)

    coefficients = values("DistortionCoeficients", "0", None)  # so spelled
    coefficients += [0.0] * (6 - len(coefficients))
    model = fields.get("DistortionModel", "perspective")
    if model not in XMP_MODELS and any(coefficients):
        unknown = f"xcr:DistortionModel {shorten(model)} is not one of {', '.join(XMP_MODELS)}"
        advice = "choose one of these in RealityCapture's alignment settings and export again"
        raise StgaError(f"{path}: {unknown}; {advice}")
    if "FocalLength35mm" not in fields:
        raise StgaError(f"{path}: xcr:FocalLength35mm is missing")
    scale = max(size)
    share = values("FocalLength35mm", "")[0] / FILM_WIDTH_MM
    lens = _realitycapture_lens(coefficients, values("Skew", "0")[0] / share if share else 0.0)
    focal = share * scale, share * scale * values("AspectRatio", "1")[0]
    cx, cy = (values(f"PrincipalPoint{axis}", "0")[0] * scale for axis in "UV")
    rotation = np.array(values("Rotation", "", 9)).reshape(3, 3)  # world to camera, OpenCV axes
    position = np.array(values("Position", "", 3))
    center = (size[0] / 2 + cx, size[1] / 2 + cy)
    camera = pinhole(size, focal, center, rotation, position, str(path))
    return Shot(path.stem, camera, lens, str(path))


def _realitycapture_lens(coefficients: list[float], skew: float = 0.0) -> Lens:
    """coefficients: k1 to k4, t1, t2; RealityCapture's t1 belongs to x, OpenCV's p1 to y."""
    k1, k2, k3, k4, t1, t2 = coefficients[:6]
    return Lens(radial=(k1, k2, k3, k4), tangential=(t2, t1), affine=(0.0, skew))
