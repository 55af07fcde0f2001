"""The one table of jobs: each request, its work, and what Blender's sidebar shows of it."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..options import like, option
from ..progress import Report, Say, Written
from ..schema import setting
from .analyze import Analyze, Analyzed, Select, TimePresets, analyze, select, time_each_preset
from .blender import RenderBlend, RenderRecording, render_blend, render_recording
from .convert_motion import ConvertMotion, convert_motion
from .export import Export, export
from .finished_run import Evaluate, Relight, evaluate, relight
from .render import Render, render
from .track import MakeAvatar, SolveAgain, Track, make_avatar, solve_again, track
from .train import Extend, Refine, Resume, Selected, SelectForTake, Train, select_for_take, train


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
Result = Written | Selected | Analyzed
Work = Callable[..., Result]
"""Called with a request, a `Report` and a `Say`; raises what `perform` does."""


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


def train_benchmark(request: Benchmark, report: Report, say: Say) -> Result:
    """Carry out a benchmark. Raises StgaError where `development` is not installed."""
    if find_spec("..development", __package__) is None:
        raise StgaError("Benchmark: can be carried out in a checkout only")
    # by name, because `development`, which the extension's zip leaves out, imports this room
    module: Any = import_module("..development.benchmark.slice", __package__)
    result: Result = module.train_slice(request, report, say)
    return result


@dataclass(frozen=True)
class Job:
    """The work of a request, and what Blender knows of it.

    kind     of those that Blender asks for; subject: the field that names what it is about
    """

    work: Work
    kind: Kind | None = None
    subject: str = ""


JOBS: dict[type[Request], Job] = {
    Train: Job(train, Kind.TRAINING, "run"), Resume: Job(train, Kind.TRAINING, "run"),
    Refine: Job(train, Kind.TRAINING, "run"), Extend: Job(train, Kind.TRAINING, "run"),
    SelectForTake: Job(select_for_take, Kind.SELECTION, "capture"),
    Track: Job(track, Kind.TRACKING, "out"),
    SolveAgain: Job(solve_again, Kind.TRACKING, "capture"),
    MakeAvatar: Job(make_avatar, Kind.AVATAR, "out"),
    Analyze: Job(analyze, Kind.ANALYSIS, "capture"),
    TimePresets: Job(time_each_preset), Select: Job(select), Evaluate: Job(evaluate),
    Relight: Job(relight, Kind.LIGHT, "run"), Render: Job(render),
    RenderRecording: Job(render_recording, Kind.VIDEO, "output"),
    RenderBlend: Job(render_blend), Export: Job(export),
    ConvertMotion: Job(convert_motion, Kind.PERFORMANCE, "output"),
    Benchmark: Job(train_benchmark),
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
        is_stored=True, trains=True
    ),
    Kind.TRACKING: RequestKind(
        "Tracking", "Stop tracking; the landmarks of whole cameras are kept, and Track continues "
        "with the others",
        ("Tracked", "Cancelled; Track continues", "Tracking failed", "Capture not found"),
        is_stored=True
    ),
    Kind.AVATAR: RequestKind(
        "Making an avatar", "Stop, and keep what there is so far; Avatar from Video with the same "
        "video continues",
        ("Avatar made", "Cancelled; Avatar from Video continues", "Making the avatar failed",
         "Its folder was not found"), is_stored=True, trains=True
    ),
    Kind.ANALYSIS: RequestKind(
        "The analysis", "Stop the analysis; earlier results stay", is_transient=True
    ),
    Kind.SELECTION: RequestKind(
        "The selection", "Stop selecting; the groups stay as they are", is_transient=True
    ),
    Kind.PERFORMANCE: RequestKind(
        "The performance of the video", "Stop watching the video; nothing is written",
        is_transient=True
    ),
    Kind.LIGHT: RequestKind(
        "The estimate of light", "Stop; the avatar stays as it is", is_transient=True
    ),
    Kind.VIDEO: RequestKind(
        "The video", "Stop making the video; nothing is written, or the PNGs that are finished "
        "stay", ("Video rendered", "Video cancelled", "Video failed", "")
    ),
}  # fmt: skip
STORED, TRAINS, TRANSIENT = (
    {kind for kind, shown in KINDS.items() if getattr(shown, name)}
    for name in ("is_stored", "trains", "is_transient")
)
DISMISSIBLE = set(KINDS) - TRANSIENT
