"""The one table of jobs: each request, its work, and what Blender's sidebar shows of it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Union

from ..progress import Written
from ..render.video import check_output
from .analyze import Analyze, Analyzed, Select, TimePresets, analyze, select, time_each_preset
from .blender import (
    RenderBlend,
    RenderRecording,
    pictures,
    render_blend,
    render_recording,
)
from .convert_motion import ConvertMotion, convert_motion
from .export import Export, export
from .finished_run import Evaluate, MakeExact, Relight, evaluate, make_exact, relight
from .render import Render, render
from .track import (
    MakeAvatar,
    SolveAgain,
    Track,
    check_inputs,
    extend,
    make_avatar,
    refuse_tracked,
    require_tracked,
    solve_again,
    track,
    untracked,
)
from .train import (
    Extend,
    Refine,
    Resume,
    Selected,
    Train,
    avatar_file,
    refuse_run,
    require_run,
    resumed,
    train_and_finish,
)

Request = (
    Train
    | Resume
    | Refine
    | Extend
    | Select
    | Track
    | MakeAvatar
    | SolveAgain
    | Render
    | RenderBlend
    | RenderRecording
    | Export
    | ConvertMotion
    | Analyze
    | TimePresets
    | Evaluate
    | Relight
    | MakeExact
)
"""Any request that `perform` carries out."""
Result = Written | Selected | Analyzed
"""What `perform` returns for a request."""

Work = Callable[..., Result]
"""Called with a request, a `Report` and a `Say`; raises what `perform` does."""


class Kind(StrEnum):
    """What Blender asks for; a scene has at most one request of each kind."""

    TRAINING = "training"
    TRACKING = "tracking"
    AVATAR = "avatar"
    ANALYSIS = "analysis"
    PERFORMANCE = "performance"
    LIGHT = "light"
    EXACT = "exact"
    VIDEO = "video"


@dataclass(frozen=True)
class Job:
    """The work of a request, and what Blender, workers and batches know of it.

    kind      of those that Blender asks for; subject: the field that names what it is about
    check     raises StgaError for what is known to fail before a worker is started
    left      request -> what is left of one that a worker began: a request, or its result
    output    the field that names what it writes
    files     request -> the files that it has written when it is finished, where `output` is none
    """

    work: Work
    kind: Kind | None = None
    subject: str = ""
    check: Callable[[Any], object] = lambda request: None
    left: Callable[[Any], Any] = lambda request: request
    output: str = ""
    files: Callable[[Any], Iterable[Path]] | None = None

    def is_written(self, request: Any) -> bool:
        """Whether what the request writes, beside its result, is there."""
        if self.files is not None:
            return all(path.exists() for path in self.files(request))
        return not self.output or getattr(request, self.output).exists()


_NEW_RUN = Job(
    train_and_finish,
    Kind.TRAINING,
    "run",
    check=refuse_run,
    left=resumed,
    output="run",
    files=avatar_file,
)
"""Job of the requests that begin a run."""

JOBS: dict[type[Any], Job] = {
    Train: _NEW_RUN,
    Refine: _NEW_RUN,
    Extend: replace(_NEW_RUN, work=extend),
    Resume: Job(train_and_finish, Kind.TRAINING, "run", check=require_run),
    Track: Job(track, Kind.TRACKING, "out", check=refuse_tracked, left=untracked, output="out"),
    SolveAgain: Job(solve_again, Kind.TRACKING, "capture", check=require_tracked),
    MakeAvatar: Job(
        make_avatar,
        Kind.AVATAR,
        "out",
        check=lambda request: check_inputs(request.track, request.takes),
    ),
    Analyze: Job(analyze, Kind.ANALYSIS, "capture"),
    TimePresets: Job(time_each_preset),
    Select: Job(select),
    Evaluate: Job(evaluate),
    Relight: Job(relight, Kind.LIGHT, "run"),
    MakeExact: Job(make_exact, Kind.EXACT, "run"),
    Render: Job(render, output="output"),
    RenderRecording: Job(
        render_recording,
        Kind.VIDEO,
        "output",
        check=lambda request: check_output(request.output),
        output="output",
    ),
    RenderBlend: Job(render_blend, output="output", files=pictures),
    Export: Job(export, output="output"),
    ConvertMotion: Job(convert_motion, Kind.PERFORMANCE, "output", output="output"),
}
"""Every request; `development.commands` adds its own in a checkout."""


def request_hint() -> Any:
    """The type hint of a field that holds any request there is."""
    return Union[tuple(JOBS)]  # noqa: UP007 (of a tuple)


@dataclass(frozen=True)
class RequestKind:
    """Texts of the sidebar for requests of a kind, and the use of their results.

    label, cancel   what is running, for messages; what Cancel does
    ends            texts when it finished, was cancelled, failed, or its folder is not found
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
        "Training",
        "Stop training and keep the avatar trained so far; Resume continues from there",
        ("Trained", "Cancelled, avatar kept", "Training failed", "Run not found"),
        is_stored=True,
        trains=True,
    ),
    Kind.TRACKING: RequestKind(
        "Tracking",
        "Stop tracking; the landmarks of whole cameras are kept, and Track continues "
        "with the others",
        ("Tracked", "Cancelled; Track continues", "Tracking failed", "Capture not found"),
        is_stored=True,
    ),
    Kind.AVATAR: RequestKind(
        "Making an avatar",
        "Stop, and keep what there is so far; Avatar from Video with the same video continues",
        (
            "Avatar made",
            "Cancelled; Avatar from Video continues",
            "Making the avatar failed",
            "Its folder was not found",
        ),
        is_stored=True,
        trains=True,
    ),
    Kind.ANALYSIS: RequestKind(
        "The analysis", "Stop the analysis; earlier results stay", is_transient=True
    ),
    Kind.PERFORMANCE: RequestKind(
        "The performance of the video",
        "Stop watching the video; nothing is written",
        is_transient=True,
    ),
    Kind.LIGHT: RequestKind(
        "The estimate of light", "Stop; the avatar stays as it is", is_transient=True
    ),
    Kind.EXACT: RequestKind(
        "Fitting colors for linear light", "Stop; the avatar stays as it is", is_transient=True
    ),
    Kind.VIDEO: RequestKind(
        "The video",
        "Stop making the video; nothing is written, or the PNGs that are finished stay",
        ("Video rendered", "Video cancelled", "Video failed", ""),
    ),
}
STORED, TRAINS, TRANSIENT = (
    {kind for kind, request in KINDS.items() if getattr(request, name)}
    for name in ("is_stored", "trains", "is_transient")
)
DISMISSIBLE = set(KINDS) - TRANSIENT
