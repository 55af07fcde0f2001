"""Footage: the cameras of a rig and their synchronized frames, undistorted and decoded on
request."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from ...capture.camera import Camera
from ...capture.images import read_image, read_mask
from ...capture.model import View
from .undistort import Undistortion


class Frames(Protocol):
    """The frames of one camera as they were recorded. Not thread-safe: a video has one decoder."""

    @property
    def timesteps(self) -> tuple[int, ...]:
        """Timesteps that have a frame, ascending."""

    def image(self, timestep: int) -> np.ndarray:
        """(H, W, 3) uint8 sRGB. Raises StgaError that names the file; KeyError for a timestep
        without a frame."""

    def mask(self, timestep: int) -> np.ndarray | None:
        """(H, W) uint8, 255 inside; None where the frame has none. Raises as `image` does."""

    def source(self, timestep: int) -> str:
        """What a message calls the frame: its file, in a video with the number of the frame."""

    @property
    def files(self) -> tuple[Path, ...]:
        """What the frames are read from: their image files, or the video."""

    def file(self, timestep: int) -> Path | None:
        """The image file whose stored pixels are the frame; None in a video, and where they are
        turned or converted."""


@dataclass(frozen=True)
class DerivedFrames:
    """`frames`, of which a subclass changes something."""

    frames: Frames

    @property
    def timesteps(self) -> tuple[int, ...]:
        return self.frames.timesteps

    def image(self, timestep: int) -> np.ndarray:
        return self.frames.image(timestep)

    def mask(self, timestep: int) -> np.ndarray | None:
        return self.frames.mask(timestep)

    def source(self, timestep: int) -> str:
        return self.frames.source(timestep)

    @property
    def files(self) -> tuple[Path, ...]:
        return self.frames.files

    def file(self, timestep: int) -> Path | None:
        return self.frames.file(timestep)


@dataclass(frozen=True)
class FootageCamera:
    """A calibrated camera and its frames, as an ideal pinhole sees them.

    name       unique in the footage
    camera     of the undistorted images, with OpenCV axes; its world has the scale and orientation
               of the calibration
    frames     as recorded
    undistortion  from the recorded frames to those of `camera`; None where the lens has no
                  distortion
    plate      image file of what the camera records without the person
    mattes     timestep -> mask file of the undistorted frame, which stands in for the recorded mask
    """

    name: str
    camera: Camera
    frames: Frames
    undistortion: Undistortion | None = None
    plate: Path | None = None
    mattes: Mapping[int, Path] = field(default_factory=dict)

    @property
    def timesteps(self) -> tuple[int, ...]:
        """Timesteps at which this camera has a frame, ascending."""
        return self.frames.timesteps

    def image(self, timestep: int) -> np.ndarray:
        """The undistorted frame (H, W, 3) uint8 sRGB; transparent pixels are laid over white.

        Reading a video in order is fast; going back decodes again from the last key frame.
        Raises StgaError that names the file; KeyError where the camera has no frame at the
        timestep.
        """
        image = self.frames.image(timestep)
        return image if self.undistortion is None else self.undistortion(image)

    def mask(self, timestep: int) -> np.ndarray | None:
        """The undistorted foreground mask (H, W) uint8, 255 inside; None where there is none.
        Raises as `image`."""
        if timestep in self.mattes:
            return read_mask(
                View(timestep, 0, self.camera, self.name, Path(self.name), self.mattes[timestep])
            )
        mask = self.frames.mask(timestep)
        return mask if mask is None or self.undistortion is None else self.undistortion(mask)

    def clean_plate(self) -> np.ndarray | None:
        """The undistorted plate (H, W, 3) uint8 sRGB; None where there is none. Raises as
        `image`."""
        if self.plate is None:
            return None
        plate = read_image(View(0, 0, self.camera, self.name, self.plate))
        return plate if self.undistortion is None else self.undistortion(plate)

    def source(self, timestep: int) -> str:
        """What a message calls the frame: its file, in a video with the number of the frame."""
        return self.frames.source(timestep)

    def file(self, timestep: int) -> Path | None:
        """An image file whose stored pixels are those of `image`; None where there is none."""
        return self.frames.file(timestep) if self.undistortion is None else None


@dataclass(frozen=True)
class Footage:
    """What was filmed: cameras with unique names, in the order of the calibration.

    timesteps   all that any camera has a frame of, ascending
    fps         frames per second of the videos, the average where it varies; None where not known,
                as for most images. Timesteps are numbers of frames
    focal       where focal lengths are from: "calibration"; of a single camera without one, "given"
                (in the request), "file" (its EXIF or QuickTime's tags), "usual" (a phone's) or
                "solved" (by tracking)
    keeps_world  whether the calibration says that the capture is to keep its world
    warnings    one sentence each
    """

    root: Path
    cameras: tuple[FootageCamera, ...]
    timesteps: tuple[int, ...]
    fps: float | None = None
    focal: str = "calibration"
    keeps_world: bool = False
    warnings: tuple[str, ...] = ()

    def views(self) -> Iterator[tuple[int, FootageCamera]]:
        """(timestep, camera) of every frame, camera by camera in order of time: the fast order for
        videos."""
        for camera in self.cameras:
            for timestep in camera.timesteps:
                yield timestep, camera
