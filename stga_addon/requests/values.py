"""Requests: what can be asked for, as plain values that any process or machine can carry out (`perform`)."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.transforms import DEFAULT_PRINCIPAL_POINT, PRINCIPAL_POINTS
from ..errors import StgaError
from ..render.device import EXPECTED_DEVICE, is_device
from ..schema import MAX_COUNT, setting
from ..training.settings import MAX_GROWTH, TrainingSettings

MATTES = ("auto", "none")
"""What `Track.mattes` may be but a folder."""


def device_field() -> Any:
    """A field for a device as `choose_device` takes it; "auto" continues a run on the device that trained it."""
    return setting("auto", accepts=is_device, expected=EXPECTED_DEVICE)


@dataclass(frozen=True)
class Train:
    """Train an avatar from a capture in a new run.

    run             folder of the run
    capture, flame, principal_point   as of `open_capture`
    preset_time     train for as long as the settings' preset takes on the device; their budget then counts for nothing
    selection       timestep -> (F,) bool, trained instead of what the rule selects
    """

    run: Path
    capture: Path
    settings: TrainingSettings
    flame: Path | None = None
    principal_point: str = setting(DEFAULT_PRINCIPAL_POINT, choices=PRINCIPAL_POINTS)
    preset_time: bool = False
    device: str = device_field()
    selection: Mapping[int, np.ndarray] | None = None

    def check(self) -> None:
        """Raise StgaError where the time is a preset's and there is none."""
        if self.preset_time and self.settings.preset is None:
            raise StgaError("preset_time: the settings name no preset")


@dataclass(frozen=True)
class Resume:
    """Continue a run that was stopped.

    capture, flame, principal_point   stand in for those that the run was begun with; None: these
    selection       timestep -> (F,) bool, where training has not begun
    """

    run: Path
    capture: Path | None = None
    flame: Path | None = None
    principal_point: str | None = setting(None, choices=PRINCIPAL_POINTS)
    device: str = device_field()
    selection: Mapping[int, np.ndarray] | None = None


@dataclass(frozen=True)
class Refine:
    """Train a region of a finished avatar further, in a run of its own.

    run, parent     folders of the new run, and of the one that it continues
    region          name of a region, or region file (`find_region`)
    weights         (F,) weight of each triangle of a painted region, instead of `region`
    frames          timesteps from first to last whose images show what is wrong; None: all
    growth          most splats that may be added, as a share of the region's
    seconds, iterations   the budget, one of the two
    flame           FLAME model file, if it has moved
    """

    run: Path
    parent: Path
    region: str = ""
    weights: np.ndarray | None = None
    frames: tuple[int, int] | None = setting(None, 0)
    growth: float = setting(0.0, 0, MAX_GROWTH)
    seconds: float | None = setting(None, above=0)
    iterations: int | None = setting(None, 1, MAX_COUNT)
    seed: int = setting(0, 0)
    flame: Path | None = None
    device: str = device_field()

    def check(self) -> None:
        """Raise StgaError unless there is one region and one budget."""
        if bool(self.region) == (self.weights is not None):
            raise StgaError("region: expected its name, its file or painted weights")
        _check_budget(self.seconds, self.iterations)


@dataclass(frozen=True)
class Extend:
    """Extend a finished avatar by further takes of the same head, in a run of its own.

    run, parent     folders of the new run, and of the one that it continues
    captures        folders of the takes
    growth          most splats that may be added, as a share of those on the triangles that the takes need
    seconds, iterations   the budget, one of the two
    flame           FLAME model file, if it has moved
    """

    run: Path
    parent: Path
    captures: tuple[Path, ...]
    growth: float = setting(0.0, 0, MAX_GROWTH)
    seconds: float | None = setting(None, above=0)
    iterations: int | None = setting(None, 1, MAX_COUNT)
    seed: int = setting(0, 0)
    flame: Path | None = None
    device: str = device_field()

    def check(self) -> None:
        """Raise StgaError unless there is a take and one budget."""
        if not self.captures:
            raise StgaError("CAPTURE: is missing; expected one or more takes to extend the run by")
        _check_budget(self.seconds, self.iterations)


@dataclass(frozen=True)
class SelectForTake:
    """Find out which triangles extending a run by a take would train."""

    parent: Path
    capture: Path
    flame: Path | None = None


@dataclass(frozen=True)
class Track:
    """Track a head through footage, and write a capture.

    footage         folder of images or videos, or a video
    model           head model file
    out             folder of the capture
    cameras         calibration that is not in the footage's folder
    landmarks       folder of landmark files of another detector
    detector        MediaPipe's face_landmarker.task
    focal           focal length of a single camera, in pixels
    start, stop, step   timesteps, `stop` excluded
    offset          camera -> frames by which its recording is later
    meshes          write an OBJ per timestep as well
    mattes          "auto": frames without a mask are given a matte; "none": they stay without; else a folder of masks
                    in place of the footage's (`open_footage`)
    """

    footage: Path
    model: Path
    out: Path
    cameras: Path | None = None
    landmarks: Path | None = None
    detector: Path | None = None
    focal: float | None = setting(None, above=0)
    start: int = setting(0, 0)
    stop: int | None = setting(None, 1)
    step: int = setting(1, 1)
    offset: Mapping[str, int] | None = None
    meshes: bool = False
    mattes: str = "auto"


@dataclass(frozen=True)
class SolveAgain:
    """Solve a tracked capture again around heads that were posed by hand.

    keys    timestep -> parameters (E + 18,) as of `correct_capture`
    """

    capture: Path
    model: Path
    keys: Mapping[int, np.ndarray]


@dataclass(frozen=True)
class RenderRecording:
    """Render the images that Blender has recorded, and encode them.

    recording       file of the images (`render.recording`), removed afterwards
    output          an .mp4 file, or a folder for PNGs
    images          how many
    background      sRGB in 0…1; None: transparent in PNGs, black in a video
    """

    recording: Path
    output: Path
    images: int = setting(minimum=0, maximum=MAX_COUNT)
    fps: float = setting(above=0)
    background: tuple[float, float, float] | None = setting(None, 0, 1)
    device: str = device_field()


@dataclass(frozen=True)
class Analyze:
    """Find out which effects a capture calls for, and how long each preset takes on this machine.

    effects         effect -> "on", "off" or "auto": the user's choices
    timed           whether presets are timed as well, which takes longer
    """

    capture: Path
    flame: Path | None = None
    principal_point: str = setting(DEFAULT_PRINCIPAL_POINT, choices=PRINCIPAL_POINTS)
    effects: Mapping[str, str] | None = None
    device: str = device_field()
    timed: bool = False


@dataclass(frozen=True)
class Evaluate:
    """Measure a run's avatar on all views of a split; the figures are also written into the run's folder.

    flame, capture  the FLAME model file and the folder of the run's capture, if they have moved
    """

    run: Path
    split: str = setting("val", choices=("train", "val", "test"))
    flame: Path | None = None
    capture: Path | None = None


Request = Train | Resume | Refine | Extend | SelectForTake | Track | SolveAgain | RenderRecording | Analyze | Evaluate


def _check_budget(seconds: float | None, iterations: int | None) -> None:
    if (seconds is None) == (iterations is None):
        raise StgaError("the budget must be given either in seconds or in iterations")
