"""Cameras of Agisoft Metashape: the XML of File > Export > Export Cameras."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ...capture.camera import MAX_FOCAL_PIXELS
from ...errors import StgaError, shorten
from .lens import Lens
from .reading import numbers, pinhole, read_xml
from .shots import Shot

PROJECTIONS = {"frame": "perspective", "fisheye": "fisheye"}


def read_metashape(path: Path) -> tuple[list[Shot], list[str]]:
    """One shot an aligned camera, labelled as in Metashape; and the labels of those that are not
    aligned.

    World and unit are the chunk's, without its transform. Raises StgaError that names file, sensor
    or camera.
    """
    root = read_xml(path)
    sensors = {sensor.get("id"): sensor for sensor in root.iter("sensor")}
    cameras = list(root.iter("camera"))
    aligned = [camera for camera in cameras if camera.find("transform") is not None]
    components = {camera.get("component_id") for camera in aligned}
    if len(components) > 1:
        raise StgaError(
            f"{path}: its cameras are in {len(components)} components; expected one alignment of all"
        )
    shots = [_shot(camera, sensors, path) for camera in aligned]
    return shots, [
        camera.get("label", "") for camera in cameras if camera.find("transform") is None
    ]


def _shot(camera: Element, sensors: dict[str | None, Element], path: Path) -> Shot:
    label = camera.get("label") or ""
    where = f"{path}: camera {shorten(label)}"
    if camera.get("sensor_id") not in sensors:
        raise StgaError(
            f"{where}: sensor_id {shorten(camera.get('sensor_id'))} is no sensor of the file"
        )
    sensor = sensors[camera.get("sensor_id")]
    size, focal, center, lens = _calibration(sensor, f"{path}: sensor {shorten(sensor.get('id'))}")
    transform = numbers(camera.findtext("transform", "").split(), f"{where}: transform", 16)
    pose = np.array(transform).reshape(4, 4)  # camera to world, OpenCV axes
    return Shot(
        label,
        pinhole(size, (focal, focal), center, pose[:3, :3].T, pose[:3, 3], where),
        lens,
        where,
    )


def _calibration(
    sensor: Element, where: str
) -> tuple[tuple[float, float], float, tuple[float, float], Lens]:
    """Image size, focal length, principal point and lens, as adjusted by the alignment where it
    was."""
    found = sensor.findall("calibration")
    calibration = next(
        (c for c in found if c.get("class") == "adjusted"), found[-1] if found else None
    )
    if calibration is None or calibration.find("f") is None:
        raise StgaError(
            f"{where}: has no calibration with f; align the cameras and export them again"
        )
    kind = calibration.get("type") or sensor.get("type")
    if kind not in PROJECTIONS:
        raise StgaError(f"{where}: type {shorten(kind)} is not one of {', '.join(PROJECTIONS)}")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise StgaError(f"{where}: resolution is missing")
    width, height = numbers(
        (resolution.get("width", ""), resolution.get("height", "")), f"{where}: resolution"
    )

    def value(name: str) -> float:
        return numbers([calibration.findtext(name, "0")], f"{where}: {name}", 1)[0]

    if value("p3") or value("p4"):
        raise StgaError(
            f"{where}: p3 and p4 are not supported; optimize the cameras without them and export again"
        )
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
