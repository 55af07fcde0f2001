"""Requests: what can be asked for, as plain values that any process or machine can carry out (`perform`)."""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import TURNTABLE_S
from ..capture.meshes import is_region_file
from ..capture.transforms import DEFAULT_PRINCIPAL_POINT, PRINCIPAL_POINTS
from ..driving.open_motion import MotionOptions
from ..errors import StgaError
from ..export.formats import FORMATS, check_suffix
from ..flame.sequence import ZERO_POSES
from ..render.device import EXPECTED_DEVICE, is_device
from ..schema import MAX_COUNT, setting
from ..selection import SelectionOptions
from ..training.settings import MAX_GROWTH, TrainingSettings

SHAPES_SUFFIX = ".csv"
WORLDS = "auto", "head", "keep"
SYNC = "none", "auto", "sound", "motion"
MATTES = "auto", "none"
"""What `Track.mattes` may be but a folder."""
CAPTURE_FOLDER, RUN_FOLDER = "capture", "run"
"""Folders in that of `MakeAvatar`."""
BLEND_SUFFIX = ".blend"
SPLATS_ENGINE = "STGA_SPLATS"
"""Blender's name of the add-on's render engine."""
MAX_FRAME = 1_048_574
"""Blender's last frame."""
FRAME_DIGITS = 6
"""Of the name of a frame's picture, as many as this at least."""


def device_field() -> Any:
    """A field for a device as `choose_device` takes it; "auto" continues a run on the device that trained it."""
    return setting("auto", accepts=is_device, expected=EXPECTED_DEVICE)


@dataclass(frozen=True)
class Train:
    """Train an avatar from a capture in a new run.

    run             folder of the run
    capture, flame, principal_point   as of `open_capture`
    selection       timestep -> (F,) bool, trained instead of what the rule selects
    """

    run: Path
    capture: Path
    settings: TrainingSettings
    flame: Path | None = None
    principal_point: str = setting(DEFAULT_PRINCIPAL_POINT, choices=PRINCIPAL_POINTS)
    device: str = device_field()
    selection: Mapping[int, np.ndarray] | None = None


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
class _Continue:
    """Continue a finished run in a run of its own.

    run, parent     folders of the new run, and of the one that it continues
    growth          most splats that may be added, as a share of those on the triangles that are trained
    seconds, iterations   the budget, one of the two
    flame           FLAME model file, if it has moved
    """

    run: Path
    parent: Path
    _: KW_ONLY
    growth: float = setting(0.0, 0, MAX_GROWTH)
    seconds: float | None = setting(None, above=0)
    iterations: int | None = setting(None, 1, MAX_COUNT)
    seed: int = setting(0, 0)
    flame: Path | None = None
    device: str = device_field()

    def check(self) -> None:
        """Raise StgaError unless there is one budget."""
        if (self.seconds is None) == (self.iterations is None):
            raise StgaError("the budget must be given either in seconds or in iterations")


@dataclass(frozen=True)
class Refine(_Continue):
    """Train a region of a finished avatar further.

    region          name of a region, or region file (`find_region`)
    weights         (F,) weight of each triangle of a painted region, instead of `region`
    frames          timesteps from first to last whose images show what is wrong; None: all
    """

    region: str = setting("", is_path=is_region_file)
    weights: np.ndarray | None = None
    frames: tuple[int, int] | None = setting(None, 0)

    def check(self) -> None:
        """Raise StgaError unless there is one region and one budget."""
        if bool(self.region) == (self.weights is not None):
            raise StgaError("region: expected its name, its file or painted weights")
        super().check()


@dataclass(frozen=True)
class Extend(_Continue):
    """Extend a finished avatar by further takes of the same head, whose folders are `captures`."""

    captures: tuple[Path, ...]

    def check(self) -> None:
        """Raise StgaError unless there is a take and one budget."""
        if not self.captures:
            raise StgaError("CAPTURE: is missing; expected one or more takes to extend the run by")
        super().check()


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
    model           head model file; None: the bundled head
    out             folder of the capture
    cameras         calibration that is not in the footage's folder
    landmarks       folder of landmark files of another detector
    focal           focal length of a single camera, in pixels
    start, stop, step   timesteps, `stop` excluded
    offset          camera -> frames by which its recording is later
    sync            how offsets that are not given are found: from the videos' "sound", their "motion", "auto": sound
                    where all have it; or "none"
    meshes          write an OBJ per timestep as well
    world           the capture's: "head": in meters, y up, the head near the origin; "keep": the cameras'; "auto": as
                    the calibration says, else "head"
    mattes          "auto": frames without a mask are given a matte; "none": they stay without; else a folder of masks
                    in place of the footage's (`open_footage`)
    """

    footage: Path
    model: Path | None
    out: Path
    cameras: Path | None = None
    landmarks: Path | None = None
    focal: float | None = setting(None, above=0)
    start: int = setting(0, 0)
    stop: int | None = setting(None, 1)
    step: int = setting(1, 1)
    offset: Mapping[str, int] | None = None
    meshes: bool = False
    world: str = setting("auto", choices=WORLDS)
    sync: str = setting("none", choices=SYNC)
    mattes: str = setting("auto", is_path=lambda text: text not in MATTES)


@dataclass(frozen=True)
class MakeAvatar:
    """Track a head through footage, and train its avatar; what an earlier request did in the same folder stays.

    track, train    write to CAPTURE_FOLDER and RUN_FOLDER of one folder, `out`; the FLAME model is that of `track`
    """

    track: Track
    train: Train

    @property
    def out(self) -> Path:
        return self.track.out.parent

    def check(self) -> None:
        """Raise StgaError where the two do not belong together."""
        wanted = self.out / CAPTURE_FOLDER, self.out / CAPTURE_FOLDER, self.out / RUN_FOLDER
        if (self.track.out, self.train.capture, self.train.run) != wanted:
            raise StgaError(f"{self.out}: expected a capture in {CAPTURE_FOLDER}, and its run in {RUN_FOLDER}")


@dataclass(frozen=True)
class SolveAgain:
    """Solve a tracked capture again around heads that were posed by hand.

    keys    timestep -> parameters (E + 18,) as of `correct_capture`
    """

    capture: Path
    model: Path
    keys: Mapping[int, np.ndarray]


@dataclass(frozen=True)
class Played:
    """What the head of an open .blend file plays in the frames of its scene, however it is animated.

    meshes      frame -> (V, 3) meters
    motion      FLAME parameters of these frames, arrays as `motion_of` takes them; None: the head has none
    selection   frame -> (F,) bool: what the file's vertex groups train; None without any
    """

    meshes: Mapping[int, np.ndarray]
    motion: Mapping[str, np.ndarray] | None = None
    selection: Mapping[int, np.ndarray] | None = None

    def check(self) -> None:
        """Raise StgaError without any frame."""
        if not self.meshes:
            raise StgaError("played: holds no frame")


@dataclass(frozen=True)
class Render:
    """Render an avatar or a PLY as pictures, a video or a turntable.

    source          folder of a run, avatar file or PLY
    output          an .mp4 file, or a folder for PNGs
    video           whether the output is a video
    cameras         transforms file: an entry per picture, or what a video's camera is one of; None: of the capture
    turntable       degrees by which one camera moves around the head, 0: as far as the cameras saw; None: it stands
                    still
    camera          index of the camera of a video or turntable; None: the central one
    fps             frames per second of a video or turntable; None: the capture's
    seconds         least duration of a turntable
    frames          first and last timestep that are rendered; None: all
    capture, flame  whose meshes drive the avatar; None: those of the run
    motion          another person's motion, which drives the avatar instead, with `motion_options`; `flame`: the file
                    of its model
    played          meshes that stand in for those of the capture
    background      sRGB in 0…1
    principal_point  convention of `cameras`; None: that of the avatar
    light           environment (.hdr) or lights (.toml) that the avatar is shown in; None: as recorded
    light_turn      degrees by which that light turns around the head during a video or turntable
    world           whether the run's world stands behind the avatar
    """

    source: Path
    output: Path
    video: bool = False
    cameras: Path | None = None
    turntable: float | None = setting(None, 0, 360)
    camera: int | None = setting(None, 0)
    fps: float | None = setting(None, 0)
    seconds: float = setting(TURNTABLE_S, 0)
    frames: tuple[int, int] | None = setting(None, 0)
    capture: Path | None = None
    flame: Path | None = None
    motion: Path | None = None
    played: Played | None = None
    background: tuple[float, float, float] = setting((1.0, 1.0, 1.0), 0, 1)
    principal_point: str | None = setting(None, choices=PRINCIPAL_POINTS)
    device: str = device_field()
    motion_options: MotionOptions = field(default_factory=MotionOptions)
    light: Path | None = None
    light_turn: float = setting(0.0, -36000, 36000)
    world: bool = False

    @property
    def is_film(self) -> bool:
        """Whether one camera sees the motion, instead of a picture per camera."""
        return self.video or self.turntable is not None

    def check(self) -> None:
        """Raise StgaError for a video of another name, and where nothing says what to render."""
        if self.video and self.output.suffix.lower() != ".mp4":
            raise StgaError(f"{self.output}: a video's name ends in .mp4")
        if self.cameras is None and not self.is_film:
            raise StgaError("--out needs --cameras, which says what to render, or --turntable")
        if self.frames is not None and self.turntable is not None:
            raise StgaError("--frames: has no effect with --turntable, which plays all of the motion")
        if self.light_turn and (self.light is None or not self.is_film):
            raise StgaError("--light-turn: has no effect without --light and --video or --turntable")


@dataclass(frozen=True)
class RenderBlend:
    """Render frames of a .blend file with the Blender of the machine, as PNGs called by their numbers (000012.png).

    output          folder; pictures that it holds already stay
    frames          first and last
    engine          as Blender's --engine takes it
    """

    blend: Path
    output: Path
    frames: tuple[int, int] = setting(minimum=0, maximum=MAX_FRAME)
    engine: str = SPLATS_ENGINE

    def check(self) -> None:
        """Raise StgaError for a file of another name, and frames in the wrong order."""
        if self.blend.suffix.lower() != BLEND_SUFFIX:
            raise StgaError(f"{self.blend}: expected a name that ends in {BLEND_SUFFIX}")
        if self.frames[0] > self.frames[1]:
            raise StgaError(f"frames: expected the first and then the last, got {self.frames[0]}, {self.frames[1]}")

    @property
    def pictures(self) -> dict[int, Path]:
        """Frame -> its file."""
        first, last = self.frames
        return {frame: self.output / f"{frame:0{FRAME_DIGITS}d}.png" for frame in range(first, last + 1)}


@dataclass(frozen=True)
class Export:
    """Write an avatar in another format.

    source          folder of a run, or avatar file
    output          the file, or the folder of a format of several
    file_format     one of FORMATS
    capture, flame  whose meshes pose the avatar; None: those of the run
    played          meshes that stand in for those of the capture
    timestep        of a format that holds one frame; None: the neutral mesh
    frames          first and last timestep of a format that holds several; None: all
    fps             of a format that has a frame rate; None: the capture's
    motion_only     of a web page: leave out the blend shapes and the skeleton of the FLAME model
    motion          another person's motion, which drives the avatar instead, with `motion_options`
    albedo          leave out the light of the capture: colors are the albedo, for programs that light splats
    """

    source: Path
    output: Path
    file_format: str = setting(choices=tuple(FORMATS))
    capture: Path | None = None
    flame: Path | None = None
    played: Played | None = None
    timestep: int | None = None
    frames: tuple[int, int] | None = None
    fps: float | None = setting(None, above=0)
    motion_only: bool = False
    motion: Path | None = None
    motion_options: MotionOptions = field(default_factory=MotionOptions)
    albedo: bool = False

    def check(self) -> None:
        """Raise StgaError for a file name of another format."""
        check_suffix(self.output, self.file_format)


@dataclass(frozen=True)
class ConvertMotion:
    """Convert a performance in ARKit's shapes to a FLAME motion, or a motion to a performance.

    source   a performance, a video of a face, FLAME parameters (.npz), or the folder of a capture tracked with FLAME
    output   ARKit's shapes (.csv) or FLAME parameters (.npz)
    flame    FLAME model file of the head
    head     folder of the capture whose identity a performance moves; None: the model's average head
    fps      frames per second of the result; None: as recorded
    """

    source: Path
    output: Path
    flame: Path | None = None
    head: Path | None = None
    fps: float | None = setting(None, above=0)
    options: MotionOptions = field(default_factory=MotionOptions)

    @property
    def writes_shapes(self) -> bool:
        return self.output.suffix.lower() == SHAPES_SUFFIX

    def check(self) -> None:
        """Raise StgaError for a file name of another format, and an option that needs an avatar."""
        if not self.writes_shapes and self.output.suffix.lower() != ".npz":
            raise StgaError(f"{self.output}: expected a name that ends in {SHAPES_SUFFIX} or .npz")
        if self.options.stay_trained is not None:
            raise StgaError("--stay-trained: has no effect here, where there is no avatar")


@dataclass(frozen=True)
class RenderRecording:
    """Render the images that Blender has recorded, and encode them.

    recording       file of the images (`render.video`), removed afterwards
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
class TimePresets:
    """Find out how long each preset would train on this machine."""

    capture: Path
    flame: Path | None = None
    principal_point: str = setting(DEFAULT_PRINCIPAL_POINT, choices=PRINCIPAL_POINTS)
    device: str = device_field()


@dataclass(frozen=True)
class Select:
    """Find out which triangles each timestep of a capture selects for training.

    threshold       meters that a triangle must move
    zero_pose       FLAME motion that does not count (`SelectionOptions`); None: the head's
    """

    capture: Path
    flame: Path | None = None
    principal_point: str = setting(DEFAULT_PRINCIPAL_POINT, choices=PRINCIPAL_POINTS)
    threshold: float = setting(SelectionOptions.threshold, 0)
    zero_pose: str | None = setting(None, choices=ZERO_POSES)


@dataclass(frozen=True)
class Evaluate:
    """Measure a run's avatar on all views of a split; the figures are also written into the run's folder.

    flame, capture  the FLAME model file and the folder of the run's capture, if they have moved
    """

    run: Path
    split: str = setting("val", choices=("train", "val", "test"))
    flame: Path | None = None
    capture: Path | None = None


@dataclass(frozen=True)
class Benchmark:
    """Train variants of the settings in turns, so that other load on the machine slows all of them alike, and measure
    their avatars. Exists in a checkout only.

    out             folder; each variant's run is in a folder of its name
    seconds         of training for each variant
    knobs           compare single settings instead of presets and strategies
    only            names of some of the variants; empty: all
    """

    out: Path
    capture: Path
    seconds: float = setting(above=0)
    flame: Path | None = None
    principal_point: str = setting(DEFAULT_PRINCIPAL_POINT, choices=PRINCIPAL_POINTS)
    seed: int = setting(0, 0)
    knobs: bool = False
    only: tuple[str, ...] = ()


@dataclass(frozen=True)
class Relight:
    """Find out the light of a run's capture, and keep it in the run's avatar, so that scenes can light it.

    light           environment (.hdr) that the capture was recorded in; None: estimated from the capture
    card            sRGB of a gray card of 18 % that faces the central camera at the face: the light's level and white
    flame, capture  the FLAME model file and the folder of the run's capture, if they have moved
    """

    run: Path
    light: Path | None = None
    card: tuple[float, float, float] | None = setting(None, 0, 1)
    flame: Path | None = None
    capture: Path | None = None

    def check(self) -> None:
        """Raise StgaError where light and card say the same."""
        if self.light is not None and self.card is not None:
            raise StgaError("--gray-card: has no effect with --light, whose level is known")


Request = (
    Train | Resume | Refine | Extend | Select | SelectForTake | Track | MakeAvatar | SolveAgain | Render
    | RenderBlend | RenderRecording | Export | ConvertMotion | Analyze | TimePresets | Evaluate | Benchmark | Relight
)  # fmt: skip
