"""Entries of calibration files: cameras and lenses as every reader returns them, and checks of
these."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ...capture.camera import MAX_FOCAL_PIXELS, Camera, is_image_size
from ...capture.lens import Lens
from ...errors import StgaError, shorten
from ...files import read_bytes

ROTATION_TOLERANCE = 1e-3
"""Some exports round rotations to a few decimals."""
MAX_POSITION = 1e12
"""Largest coordinate of a camera, in the calibration's unit: millimeters from the center of the
earth are 1e10."""


@dataclass(frozen=True)
class Shot:
    """One calibrated image of a calibration file.

    label     as in the file: the camera's name, or the path of the image it was calibrated with
    camera    pose and intrinsics of the image as recorded; `lens` distorts it
    where     file and entry, with which messages begin
    image     the image, where the file states that it is a frame of the footage; then with its
              timestep
    mask      its foreground mask
    camera_name  what the file calls the camera of several images
    fps       frames per second that the file states, whose numbers the timesteps are
    keeps_world  whether the file states that its world is that of a scene, which the capture is to
                 keep
    is_as_stored  whether it was calibrated with the pixels as stored, without EXIF's orientation
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
    is_as_stored: bool = False


Calibrated = tuple[list[Shot], tuple[str, ...]]
"""Cameras with a pose; and a sentence for each kind of what was left out, guessed or repaired."""
ImageSize = Callable[[str], tuple[int, int]]
"""Label of a camera -> (width, height), which some files do not say. Raises StgaError."""


def read_xml(path: Path) -> ElementTree.Element:
    """The root element. Raises StgaError where it is malformed, or declares entities."""
    data = read_bytes(path)

    class Builder(ElementTree.TreeBuilder):
        def doctype(self, *_: str | None) -> None:  # which the parser finds in any encoding
            raise StgaError(f"{path}: declares a document type; expected a calibration")

    try:
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=Builder()))
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
        raise StgaError(
            f"{where}: expected {some}finite number{'' if count == 1 else 's'}, not "
            f"{shorten(' '.join(words))}"
        )
    return values


def pinhole(
    size: tuple[float, float],
    focal: tuple[float, float],
    center: tuple[float, float],
    rotation: np.ndarray,
    position: np.ndarray,
    where: str,
) -> Camera:
    """Camera of a calibration. size, focal, center: (x, y) in pixels, the center from the top-left
    corner. rotation (3, 3) from world to OpenCV's camera axes; position (3,) of the camera in the
    calibration's world, whose unit is free. Raises StgaError, beginning with `where`, for a size,
    focal length, principal point or pose that no camera has."""
    (width, height) = size
    (fl_x, fl_y) = focal
    (cx, cy) = center
    limit = MAX_FOCAL_PIXELS
    bounded = np.abs(rotation).max() <= 1 + ROTATION_TOLERANCE  # else, products overflow
    skewed = np.abs(rotation @ rotation.T - np.eye(3)).max() if bounded else np.inf
    for fits, expected in (
        (is_image_size(width, height), f"an image size in pixels, not {width:g} x {height:g}"),
        (
            all(1 <= value <= limit for value in focal),
            f"a focal length of 1 to 1e7 pixels, not {fl_x:g}, {fl_y:g}",
        ),
        (
            all(abs(value) <= limit for value in center),  # nor NaN
            f"a principal point within {limit:g} pixels, not {cx:g}, {cy:g}",
        ),
        (
            (np.abs(position) <= MAX_POSITION).all(),
            f"a camera within {MAX_POSITION:g} units of the origin",
        ),
        (skewed <= ROTATION_TOLERANCE, "a rotation without scale or shear"),
    ):
        if not fits:
            raise StgaError(f"{where}: expected {expected}")
    if np.linalg.det(rotation) < 0:
        raise StgaError(f"{where}: its axes are mirrored; expected a right-handed rotation")
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ position
    return Camera(int(width), int(height), fl_x, fl_y, cx, cy, pose)
