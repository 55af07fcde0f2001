"""Entries of calibration files: what every reader of cameras returns, bounded reads of the files,
and checks of the cameras in them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ...capture.camera import MAX_FOCAL_PIXELS, Camera, is_image_size
from ...errors import StgaError, shorten
from ...files import read_bytes
from .lens import Lens

ROTATION_TOLERANCE = 1e-3  # some exports round rotations to a few decimals
MAX_POSITION = 1e12
"""Of a camera, in the calibration's unit: millimeters from the center of the earth are 1e10."""


@dataclass(frozen=True)
class Shot:
    """One calibrated image of a calibration file.

    label     as in the file: the camera's name, or the path of the image it was calibrated with
    camera    pose and intrinsics of the image as recorded; `lens` distorts it
    where     file and entry, with which messages begin
    image     the image, where the file says that it is a frame of the footage; then with its
              timestep
    mask      its foreground mask
    camera_name  what the file calls the camera of several images
    fps       frames per second that the file states, whose numbers the timesteps are
    keeps_world  whether the file says that its world is that of a scene, which the capture is to
                 keep
    """

    label: str
    camera: Camera
    lens: Lens
    where: str
    image: Path | None = None
    timestep: int | None = None
    mask: Path | None = None
    camera_name: str | None = None
    fps: float | None = None
    keeps_world: bool = False


def read_text(path: Path) -> str:
    """The file, with or without a byte order mark. Raises StgaError, also where not UTF-8."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except ValueError as error:
        raise StgaError(f"{path}: is not UTF-8 text ({error})") from error


def read_xml(path: Path) -> ElementTree.Element:
    """The root element. Raises StgaError where it is malformed, or declares entities."""
    data = read_bytes(path)
    if b"<!DOCTYPE" in data:
        raise StgaError(f"{path}: declares a document type; expected a calibration")
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise StgaError(f"{path}: is not valid XML ({error})") from error


def numbers(words: Iterable[str], where: str, count: int | None = None) -> list[float]:
    """Finite numbers. Raises StgaError, beginning with `where`, for others or another count."""
    words = list(words)
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values) or count not in (None, len(values)):
        some = "" if count is None else f"{count} "
        expected = f"{some}finite number{'' if count == 1 else 's'}"
        raise StgaError(f"{where}: expected {expected}, not {shorten(' '.join(words))}")
    return values


def pinhole(
    size: tuple[float, float],
    focal: tuple[float, float],
    center: tuple[float, float],
    rotation: np.ndarray,
    position: np.ndarray,
    where: str,
) -> Camera:
    """Camera of a calibration.

    size, focal, center: (x, y) in pixels, the center from the top-left corner. rotation (3, 3) from
    world to OpenCV's camera axes; position (3,) of the camera in the calibration's world, whose
    unit is free. Raises StgaError, beginning with `where`, for a size, focal length, principal
    point or pose that no camera has.
    """
    if not is_image_size(*size):
        raise StgaError(f"{where}: expected an image size in pixels, not {size[0]:g} x {size[1]:g}")
    if not all(1 <= value <= MAX_FOCAL_PIXELS for value in focal):
        raise StgaError(
            f"{where}: expected a focal length of 1 to 1e7 pixels, not {focal[0]:g}, {focal[1]:g}"
        )
    if not all(abs(value) <= MAX_FOCAL_PIXELS for value in center):  # also where it is not a number
        found = f"{center[0]:g}, {center[1]:g}"
        raise StgaError(
            f"{where}: expected a principal point within {MAX_FOCAL_PIXELS:g} pixels, not {found}"
        )
    if not (np.abs(position) <= MAX_POSITION).all():
        raise StgaError(f"{where}: expected a camera within {MAX_POSITION:g} units of the origin")
    bounded = np.abs(rotation).max() <= 1 + ROTATION_TOLERANCE
    if not bounded or np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE:
        raise StgaError(f"{where}: expected a rotation without scale or shear")
    if np.linalg.det(rotation) < 0:
        raise StgaError(f"{where}: its axes are mirrored; expected a right-handed rotation")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return Camera(int(size[0]), int(size[1]), *focal, *center, pose)
