"""State of the training that a Blender scene shows, and its transitions, without Blender."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from ..training.run.folder import AVATAR
from ..worker.status import WorkerSnapshot, WorkerState
from .folder import PREVIEW, request_folder

CHECK_INTERVAL_S = 0.5
SLICE_INTERVAL_S = 0.02
"""While splats are built in slices, so that Blender never blocks for long."""

Stamp = tuple[int, int]
"""Modification time in nanoseconds and size in bytes of a file."""


@dataclass(frozen=True)
class RunFiles:
    """Stamps of a run's files; None: there is no such file."""

    preview: Stamp | None = None
    metrics: Stamp | None = None
    tracking: Stamp | None = None


@dataclass(frozen=True)
class MonitorState:
    """What is known of the training of one scene.

    run             the folder that the scene and its splats name; None: the scene has no training
    folder          where that folder is now: it may have moved along with the .blend file
    snapshot        the worker's status as last read
    files           of the folder, as last seen
    result_shown    the final avatar has reached the scene, or never will
    shown_preview   stamp of the preview that was loaded last
    loading         avatar file that is being read, or built in slices
    building        it is being built
    error           one sentence: an avatar that could not be shown, or why monitoring stopped
    stopped         monitoring stopped after an unexpected error
    """

    run: Path | None = None
    folder: Path | None = None
    snapshot: WorkerSnapshot = field(default_factory=WorkerSnapshot)
    files: RunFiles = field(default_factory=RunFiles)
    result_shown: bool = False
    shown_preview: Stamp | None = None
    loading: Path | None = None
    building: bool = False
    error: str = ""
    stopped: bool = False

    @property
    def interval_s(self) -> float | None:
        """Seconds until the next check; None: nothing is expected any more, the timer can stop."""
        if self.run is None or self.stopped:
            return None
        if self.building:
            return SLICE_INTERVAL_S
        is_expected = self.snapshot.state.is_alive or self.loading is not None or self.has_result
        return CHECK_INTERVAL_S if is_expected else None

    @property
    def has_result(self) -> bool:
        """Whether training has ended with an avatar that is still to be shown."""
        return self.snapshot.state in (WorkerState.FINISHED, WorkerState.CANCELLED) and not self.result_shown


# Events


@dataclass(frozen=True)
class FileLoaded:
    """The scene is seen for the first time, with what is stored in it."""

    run: Path | None
    result_shown: bool


@dataclass(frozen=True)
class Started:
    """A worker was started for a run."""

    run: Path


@dataclass(frozen=True)
class Dismissed:
    """The user dismissed the result of a training."""


@dataclass(frozen=True)
class SceneRead:
    """What is stored in the scene now: an undo step may have taken it back."""

    run: Path | None
    result_shown: bool


@dataclass(frozen=True)
class StatusRead:
    """The run's folder was read. live_preview, show_result: what the user wants to see."""

    folder: Path
    snapshot: WorkerSnapshot
    files: RunFiles = field(default_factory=RunFiles)
    live_preview: bool = True
    show_result: bool = True


@dataclass(frozen=True)
class SliceBuilt:
    """A slice of the avatar was built, others remain."""


@dataclass(frozen=True)
class AvatarShown:
    """The avatar that was loaded is in the scene. created: in a new object."""

    created: bool


@dataclass(frozen=True)
class AvatarFailed:
    """The avatar cannot be shown."""

    sentence: str


@dataclass(frozen=True)
class MonitorFailed:
    """An unexpected error occurred."""

    sentence: str


Event = (
    FileLoaded | Started | Dismissed | SceneRead | StatusRead | SliceBuilt | AvatarShown | AvatarFailed | MonitorFailed
)


# Effects


@dataclass(frozen=True)
class StoreTraining:
    """Store the run, and whether its result was shown, in the scene."""

    run: Path | None
    result_shown: bool


@dataclass(frozen=True)
class StoreAvatar:
    """Store the path of the trained avatar in the scene."""

    path: Path


@dataclass(frozen=True)
class LoadAvatar:
    """Read an avatar file in a thread, then show it on the scene's head."""

    path: Path


@dataclass(frozen=True)
class ReadCurve:
    """Read the evaluations in the folder for the panel's curve."""

    folder: Path


@dataclass(frozen=True)
class PushUndo:
    """Add an undo step."""


@dataclass(frozen=True)
class Redraw:
    """Redraw the panels."""


Effect = StoreTraining | StoreAvatar | LoadAvatar | ReadCurve | PushUndo | Redraw
Outcome = tuple[MonitorState, tuple[Effect, ...]]


def transition(state: MonitorState, event: Event) -> Outcome:
    """The state after an event, and the effects to carry out in this order."""
    match event:
        case FileLoaded(run, result_shown):
            return MonitorState(run, run, result_shown=result_shown), ()
        case Started(run):
            return MonitorState(run, run), (StoreTraining(run, False), ReadCurve(run), Redraw())
        case Dismissed():
            return MonitorState(), (StoreTraining(None, False), Redraw())
        case SceneRead(run, result_shown):
            in_step = (run, result_shown) == (state.run, state.result_shown)
            return state, () if in_step else (StoreTraining(state.run, state.result_shown),)
        case StatusRead():
            return _status_read(state, event)
        case SliceBuilt():
            return replace(state, building=True), ()
        case AvatarShown(created):
            return _loading_ended(state, "", (PushUndo(),) if created else ())
        case AvatarFailed(sentence):
            return _loading_ended(state, sentence, ())
        case MonitorFailed(sentence):
            return replace(state, error=sentence, stopped=True, loading=None, building=False), (Redraw(),)


def _status_read(state: MonitorState, event: StatusRead) -> Outcome:
    effects: list[Effect] = []
    folder, files, worker = event.folder, event.files, event.snapshot.state
    if (folder, files.metrics) != (state.folder, state.files.metrics):
        effects.append(ReadCurve(folder))
    if (folder, files, event.snapshot) != (state.folder, state.files, state.snapshot):
        effects.append(Redraw())
    error = "" if state.stopped else state.error
    state = replace(state, folder=folder, files=files, snapshot=event.snapshot, error=error, stopped=False)
    if state.loading is not None:
        return state, tuple(effects)
    has_preview = worker.is_alive and files.preview not in (None, state.shown_preview)
    if state.has_result:
        effects.append(StoreAvatar(folder / AVATAR))
        if event.show_result:
            state = replace(state, loading=folder / AVATAR)
        else:
            state = replace(state, result_shown=True)
            effects.append(StoreTraining(state.run, True))
    elif has_preview and event.live_preview:
        state = replace(state, loading=request_folder(folder) / PREVIEW, shown_preview=files.preview)
    if state.loading is not None:
        effects.append(LoadAvatar(state.loading))
    return state, tuple(effects)


def _loading_ended(state: MonitorState, error: str, effects: tuple[Effect, ...]) -> Outcome:
    was_result = state.loading is not None and state.loading.name == AVATAR
    state = replace(state, loading=None, building=False, error=error, result_shown=state.result_shown or was_result)
    stored = (StoreTraining(state.run, True),) if was_result else ()
    if was_result and not error and PushUndo() not in effects:
        effects = (*effects, PushUndo())  # undo brings back what was shown before the training
    return state, (*stored, *effects, Redraw())
