"""The one table of jobs: each request, its work, and what Blender's sidebar shows of it."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from ..options import like, option
from ..schema import setting
from .analyze import Analyze, Select, TimePresets
from .blender import RenderBlend, RenderRecording
from .convert_motion import ConvertMotion
from .export import Export
from .finished_run import Evaluate, Relight
from .render import Render
from .track import MakeAvatar, SolveAgain, Track
from .train import Extend, Refine, Resume, SelectForTake, Train


@dataclass(frozen=True)
class Benchmark:
    """Train variants of the settings in turns, so that other load on the machine slows all of them
    alike, and measure their avatars. Exists in a checkout only.

    out             folder; each variant's run is in a folder of its name
    seconds         of training for each variant
    knobs           compare single settings instead of presets and strategies
    only            names of some of the variants; empty: all
    """

    out: Path
    capture: Path = like(Train, "capture")
    seconds: float = setting(above=0)
    flame: Path | None = like(Train, "flame")
    principal_point: str = like(Train, "principal_point")
    seed: int = setting(0, 0)
    knobs: bool = option("compare single settings instead", False)
    only: tuple[str, ...] = ()


Request = (
    Train | Resume | Refine | Extend | Select | SelectForTake | Track | MakeAvatar | SolveAgain
    | Render | RenderBlend | RenderRecording | Export | ConvertMotion | Analyze | TimePresets
    | Evaluate | Benchmark | Relight
)  # fmt: skip


class Kind(StrEnum):
    """What Blender asks for; a scene has at most one request of each kind."""

    TRAINING = "training"
    TRACKING = "tracking"
    AVATAR = "avatar"
    ANALYSIS = "analysis"
    SELECTION = "selection"
    PERFORMANCE = "performance"
    LIGHT = "light"
    VIDEO = "video"


@dataclass(frozen=True)
class Job:
    """The work of a request, and what Blender knows of it.

    work     module and function, loaded when they are needed; the extension's zip leaves
             `development` out
    kind     of those that Blender asks for; subject: the field that names what it is about
    """

    work: str
    kind: Kind | None = None
    subject: str = ""


JOBS: dict[type[Request], Job] = {
    Train: Job(".train.train", Kind.TRAINING, "run"),
    Resume: Job(".train.train", Kind.TRAINING, "run"),
    Refine: Job(".train.train", Kind.TRAINING, "run"),
    Extend: Job(".train.train", Kind.TRAINING, "run"),
    SelectForTake: Job(".train.select_for_take", Kind.SELECTION, "capture"),
    Track: Job(".track.track", Kind.TRACKING, "out"),
    SolveAgain: Job(".track.solve_again", Kind.TRACKING, "capture"),
    MakeAvatar: Job(".track.make_avatar", Kind.AVATAR, "out"),
    Analyze: Job(".analyze.analyze", Kind.ANALYSIS, "capture"),
    TimePresets: Job(".analyze.time_each_preset"), Select: Job(".analyze.select"),
    Evaluate: Job(".finished_run.evaluate"),
    Relight: Job(".finished_run.relight", Kind.LIGHT, "run"), Render: Job(".render.render"),
    RenderRecording: Job(".blender.render_recording", Kind.VIDEO, "output"),
    RenderBlend: Job(".blender.render_blend"), Export: Job(".export.export"),
    ConvertMotion: Job(".convert_motion.convert_motion", Kind.PERFORMANCE, "output"),
    Benchmark: Job("..development.benchmark.slice.train_slice"),
}  # fmt: skip


@dataclass(frozen=True)
class RequestKind:
    """What the sidebar says of requests of a kind, and what becomes of their results.

    label, cancel   what is running, for messages; what Cancel does
    ends            what is said when it finished, was cancelled, failed, or its folder is not found
    is_stored       the .blend file remembers it; its folder is in that of what it makes, others'
                    are temporary
    trains          it has a run, whose previews and avatar are shown on the head
    is_transient    it leaves nothing but its result in the scene: killed when it is cancelled, gone
                    when it ended
    """

    label: str
    cancel: str
    ends: tuple[str, str, str, str] = ("", "", "", "")
    is_stored: bool = False
    trains: bool = False
    is_transient: bool = False


KINDS = {
    Kind.TRAINING: RequestKind(
        "Training", "Stop training and keep the avatar trained so far; Resume continues from there",
        ("Trained", "Cancelled, avatar kept", "Training failed", "Run not found"),
        is_stored=True, trains=True,
    ),
    Kind.TRACKING: RequestKind(
        "Tracking", "Stop tracking; the landmarks of whole cameras are kept, and Track continues "
        "with the others",
        ("Tracked", "Cancelled; Track continues", "Tracking failed", "Capture not found"),
        is_stored=True,
    ),
    Kind.AVATAR: RequestKind(
        "Making an avatar", "Stop, and keep what there is so far; Avatar from Video with the same "
        "video continues",
        ("Avatar made", "Cancelled; Avatar from Video continues", "Making the avatar failed",
         "Its folder was not found"), is_stored=True, trains=True,
    ),
    Kind.ANALYSIS: RequestKind(
        "The analysis", "Stop the analysis; earlier results stay", is_transient=True
    ),
    Kind.SELECTION: RequestKind(
        "The selection", "Stop selecting; the groups stay as they are", is_transient=True
    ),
    Kind.PERFORMANCE: RequestKind(
        "The performance of the video", "Stop watching the video; nothing is written",
        is_transient=True,
    ),
    Kind.LIGHT: RequestKind(
        "The estimate of light", "Stop; the avatar stays as it is", is_transient=True
    ),
    Kind.VIDEO: RequestKind(
        "The video", "Stop making the video; nothing is written, or the PNGs that are finished "
        "stay", ("Video rendered", "Video cancelled", "Video failed", ""),
    ),
}  # fmt: skip
STORED, TRAINS, TRANSIENT = (
    {kind for kind, shown in KINDS.items() if getattr(shown, name)}
    for name in ("is_stored", "trains", "is_transient")
)
DISMISSIBLE = set(KINDS) - TRANSIENT
