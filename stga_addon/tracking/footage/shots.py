"""Entries of a calibration file: what every reader of cameras returns."""

from dataclasses import dataclass
from pathlib import Path

from ...capture.camera import Camera
from .lens import Lens


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
