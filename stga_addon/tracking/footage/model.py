"""Footage: a rig's cameras and synchronized frames, undistorted and decoded on request."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ...capture.camera import Camera
from ...capture.images import image_size, is_plain, read_image, read_mask
from ...capture.lens import Undistortion
from ...capture.model import View
from ...files import replacing
from .video import VideoFrames


@dataclass(frozen=True)
class ImageFrames:
    """Frames that are image files, with the attributes of `VideoFrames`.

    views  timestep -> the image as recorded, ascending; its camera says how large it must be
    """

    views: Mapping[int, View]

    @property
    def timesteps(self) -> tuple[int, ...]:
        return tuple(self.views)

    def sizes(self) -> Iterator[tuple[Path, tuple[int, int]]]:
        """Width and height of each file, from its header."""
        views = self.views.values()
        return ((view.image, image_size(view.image, view.is_as_stored)) for view in views)

    def image(self, timestep: int) -> np.ndarray:
        return read_image(self.views[timestep])

    def mask(self, timestep: int) -> np.ndarray | None:
        return read_mask(self.views[timestep])

    def source(self, timestep: int) -> str:
        return str(self.views[timestep].image)

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(view.image for view in self.views.values())

    def file(self, timestep: int) -> Path | None:
        image = self.views[timestep].image
        return image if is_plain(image) else None


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write gray pixels (H, W) or BGR (H, W, 3), uint8: by OpenCV, in a fifth of Pillow's time."""
    import cv2

    with replacing(path) as partial:
        partial.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def read_png(path: Path) -> np.ndarray | None:
    """What `write_png` wrote, (H, W, 3) uint8 sRGB, in two thirds of Pillow's time; None where the
    file is damaged."""
    import cv2

    data = np.frombuffer(path.read_bytes(), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if len(data) else None


Frames = ImageFrames | VideoFrames  # The frames of one camera as they were recorded


@dataclass(frozen=True)
class FootageCamera:
    """A calibrated camera and its frames, as an ideal pinhole sees them.

    name       unique in the footage
    camera     of the undistorted images, with OpenCV axes; its world has the scale and orientation
               of the calibration
    frames     as recorded. Not thread-safe: a video has one decoder
    undistortion  from the recorded frames to those of `camera`; None where the lens has no
                  distortion
    plate      image file of what the camera records without the person
    mattes     timestep -> mask file of the undistorted frame, which stands in for the recorded mask
    kept       timestep -> PNG that a frame is kept in from its first use, where that is no file yet
    """

    name: str
    camera: Camera
    frames: Frames
    undistortion: Undistortion | None = None
    plate: Path | None = None
    mattes: Mapping[int, Path] = field(default_factory=dict)
    kept: Mapping[int, Path] = field(default_factory=dict)

    @property
    def timesteps(self) -> tuple[int, ...]:
        """Timesteps at which this camera has a frame, ascending."""
        return self.frames.timesteps

    def image(self, timestep: int) -> np.ndarray:
        """The undistorted frame (H, W, 3) uint8 sRGB; transparent pixels are laid over white.
        Reading a video in order is fast; going back decodes again from the last key frame. Raises
        StgaError that names the file; KeyError where the camera has no frame at the timestep."""
        kept = self.kept.get(timestep)
        if kept is not None and kept.exists():
            found = read_png(kept)
            if found is not None and found.shape[:2] == (self.camera.height, self.camera.width):
                return found
            return read_image(View(timestep, 0, self.camera, self.name, kept))
        image = self._undistorted(self.frames.image(timestep))
        if kept is not None:
            write_png(kept, image[..., ::-1])
        return image

    def mask(self, timestep: int) -> np.ndarray | None:
        """The undistorted mask (H, W) uint8, 255 inside; None without. Raises as `image`."""
        if timestep in self.mattes:
            name = self.name
            matte = self.mattes[timestep]
            return read_mask(View(timestep, 0, self.camera, name, Path(name), matte))
        mask = self.frames.mask(timestep)
        return None if mask is None else self._undistorted(mask)

    def clean_plate(self) -> np.ndarray | None:
        """The undistorted plate (H, W, 3) uint8 sRGB; None without. Raises as `image`."""
        if self.plate is None:
            return None
        return self._undistorted(read_image(View(0, 0, self.camera, self.name, self.plate)))

    def _undistorted(self, image: np.ndarray) -> np.ndarray:
        return image if self.undistortion is None else self.undistortion(image)

    def source(self, timestep: int) -> str:
        """What a message calls the frame: its file, in a video with the number of the frame."""
        return self.frames.source(timestep)

    def file(self, timestep: int) -> Path | None:
        """An image file whose stored pixels are those of `image`; None where there is none."""
        if timestep in self.kept:
            return self.kept[timestep] if self.kept[timestep].exists() else None
        return self.frames.file(timestep) if self.undistortion is None else None


@dataclass(frozen=True)
class Footage:
    """What was filmed: cameras with unique names, in the order of the calibration.

    fps         frames per second of the videos, the average where it varies; None where not known,
                as for most images. Timesteps are numbers of frames
    focal       where focal lengths are from: "calibration"; of a single camera without one, "given"
                (in the request), "file" (its EXIF or QuickTime's tags), "usual" (a phone's), or by
                tracking "estimated" (from landmarks) or "avatar" (that of its camera)
    keeps_world  whether the calibration states that the capture is to keep its world
    warnings    one sentence each
    finds_cameras  whether cameras were found in the very images
    """

    root: Path
    cameras: tuple[FootageCamera, ...]
    fps: float | None = None
    focal: str = "calibration"
    keeps_world: bool = False
    warnings: tuple[str, ...] = ()
    finds_cameras: bool = False

    def keeps(self, world: str) -> bool:
        """Whether the cameras stay where they are, of "head", "keep" and "auto" (as in the
        calibration)."""
        return world == "keep" or (world == "auto" and self.keeps_world)

    @cached_property
    def timesteps(self) -> tuple[int, ...]:
        """All that any camera has a frame of, ascending."""
        return tuple(sorted({t for camera in self.cameras for t in camera.timesteps}))

    def views(self) -> Iterator[tuple[int, FootageCamera]]:
        """(timestep, camera) of every frame, camera by camera: the fast order for videos."""
        for camera in self.cameras:
            for timestep in camera.timesteps:
                yield timestep, camera
