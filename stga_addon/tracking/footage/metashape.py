"""Cameras of Metashape's XML (File > Export > Export Cameras), and of PhotoScan's."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ...capture.camera import MAX_FOCAL_PIXELS
from ...capture.lens import Lens
from ...errors import StgaError, listed, shorten
from .shots import Calibrated, Shot, numbers, pinhole, read_xml

PROJECTIONS = {
    "frame": "perspective",
    "fisheye": "fisheye",
    "equidistant_fisheye": "fisheye",  # as Metashape 2.1 calls it
    "equisolid_fisheye": "equisolid fisheye",
}
"""Type of a sensor -> projection of a lens."""
Pair = tuple[float, float]


def is_metashape(head: str) -> bool:
    """Whether a file begins as Metashape's export; others write XML files beside images, too."""
    return "<document" in head and "<chunk" in head


def read_metashape(path: Path) -> Calibrated:
    """One shot an aligned camera that is enabled, labelled as in Metashape, with the label of its
    group as a folder. World and unit are the chunk's, without its transform. Of several chunks, and
    of several components in one, the one of most cameras is read. Raises StgaError that names file,
    sensor or camera."""
    root = read_xml(path)
    chunks = list(root.iter("chunk")) or [root]
    chunk = max(chunks, key=lambda each: len(_aligned(each)))
    others = [_count(each, "chunk") for each in chunks if each is not chunk and _aligned(each)]
    cameras = _aligned(chunk)
    component = None
    components = Counter(camera.get("component_id") for camera in cameras)
    if components:
        component = components.most_common(1)[0][0]
        rest = [each for each in components if each != component]
        others += [f"component {each} ({components[each]} cameras)" for each in rest]
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    labels = _labels(chunk)
    shots = []
    for camera in cameras:
        if camera.get("component_id") == component:
            shots.append(_shot(path, camera, labels[camera], sensors))
    without_pose = list[str]()
    disabled = list[str]()
    for camera in chunk.iter("camera"):
        if not _is_enabled(camera):
            disabled.append(labels[camera])
        elif camera.find("transform") is None:
            without_pose.append(labels[camera])
    left_out = {
        "cameras without a pose": without_pose,
        "disabled cameras": disabled,
        "smaller alignments": others,
    }
    return shots, tuple(
        f"left out {what}: {listed(names)}" for what, names in left_out.items() if names
    )


def _count(chunk: Element, what: str) -> str:
    return f"{what} {shorten(chunk.get('label') or '')} ({len(_aligned(chunk))} cameras)"


def _is_enabled(camera: Element) -> bool:
    return camera.get("enabled", "1").lower() not in ("false", "0")


def _aligned(chunk: Element) -> list[Element]:
    cameras = chunk.iter("camera")
    return [
        camera for camera in cameras if _is_enabled(camera) and camera.find("transform") is not None
    ]


def _labels(chunk: Element) -> dict[Element, str]:
    """Camera -> label, behind that of its group: images of cameras that are named alike lie in
    folders, which Metashape makes groups of."""
    labels = {camera: camera.get("label") or "" for camera in chunk.iter("camera")}
    for group in chunk.iter("group"):
        name = group.get("label")
        members = group.iter("camera") if name else ()
        labels |= {camera: f"{name}/{labels[camera]}" for camera in members}
    return labels


def _shot(path: Path, camera: Element, label: str, sensors: dict[str | None, Element]) -> Shot:
    number = camera.get("sensor_id")
    where = f"{path}: camera {shorten(label)}"
    if number not in sensors:
        raise StgaError(f"{where}: sensor_id {shorten(number)} is no sensor of the file")
    size, focals, center, lens = _sensor(sensors[number], f"{path}: sensor {shorten(number)}")
    transform = numbers(camera.findtext("transform", "").split(), f"{where}: transform", 16)
    pose = np.array(transform).reshape(4, 4)  # camera to world, OpenCV axes
    posed = pinhole(size, focals, center, pose[:3, :3].T, pose[:3, 3], where)
    return Shot(label, posed, lens, where)


def _sensor(sensor: Element, where: str) -> tuple[Pair, Pair, Pair, Lens]:
    """Image size, focal lengths, principal point and lens, adjusted by the alignment or not.
    PhotoScan before 1.3 writes fx, fy, and the principal point from the corner."""
    found: Sequence[Element] = sensor.findall("calibration")
    adjusted = (c for c in found if c.get("class") == "adjusted")
    calibration = next(adjusted, found[-1] if found else None)
    is_old = calibration is not None and calibration.find("fx") is not None
    if calibration is None or (calibration.find("f") is None and not is_old):
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
    sides = resolution.get("width", ""), resolution.get("height", "")
    width, height = numbers(sides, f"{where}: resolution")

    def value(name: str) -> float:
        return numbers([calibration.findtext(name, "0")], f"{where}: {name}", 1)[0]

    if value("p3") or value("p4"):
        raise StgaError(
            f"{where}: p3 and p4 are not supported; optimize the cameras without them and "
            "export again"
        )
    focal = value("fx" if is_old else "f")
    if not 1 <= focal <= MAX_FOCAL_PIXELS:
        raise StgaError(f"{where}: f: expected a focal length of 1 to 1e7 pixels, not {focal:g}")
    lens = Lens(
        PROJECTIONS[kind],
        radial=(value("k1"), value("k2"), value("k3"), value("k4")),
        tangential=(value("p2"), value("p1")),  # Metashape's p1 belongs to x, OpenCV's to y
        affine=(value("b1") / focal, value("b2") / focal),
    )
    if is_old:
        skew = value("skew") / focal
        lens = replace(lens, affine=(0.0, skew))
        return (width, height), (focal, value("fy")), (value("cx"), value("cy")), lens
    center = width / 2 + value("cx"), height / 2 + value("cy")
    return (width, height), (focal, focal), center, lens
