"""State of a request that Blender follows, and its transitions, without Blender."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from ..training.run.folder import AVATAR
from ..worker.status import PREVIEW, WorkerSnapshot, WorkerState
from .table import DISMISSIBLE, STORED, TRAINS, TRANSIENT, Kind
from .track import CAPTURE_FOLDER, RUN_FOLDER

CHECK_INTERVAL_S = 0.5
SLICE_INTERVAL_S = 0.02  # While splats are built in slices, so that Blender never blocks for long

Stamp = tuple[int, int]  # Modification time in nanoseconds and size in bytes of a file


@dataclass(frozen=True)
class RunFiles:
    """Stamps of a run's files, and of the capture that is tracked for it; None: no such file."""

    capture: Stamp | None = None
    picture: Stamp | None = None
    preview: Stamp | None = None
    avatar: Stamp | None = None
    metrics: Stamp | None = None
    tracking: Stamp | None = None


@dataclass(frozen=True)
class RequestState:
    """What is known of a scene's request of one kind.

    subject         run, capture or video that the request is about, as the scene names it; None:
                    none
    folder          of the request, as found now: a run may have moved along with the .blend file
    snapshot        the worker's status as last read
    files           of a run, as last seen
    result_shown    the result has reached the scene, or never will
    displayed_capture, displayed_preview   stamps of those that were loaded last
    loading         what is being read, or put into the scene: an avatar file, or the folder of the
                    request
    building        it is being built in slices
    error           one sentence: a result that could not be shown, or why monitoring stopped
    stopped         monitoring stopped after an unexpected error
    """

    kind: Kind
    subject: Path | None = None
    folder: Path | None = None
    snapshot: WorkerSnapshot = field(default_factory=WorkerSnapshot)
    files: RunFiles = field(default_factory=RunFiles)
    result_shown: bool = False
    displayed_capture: Stamp | None = None
    displayed_preview: Stamp | None = None
    loading: Path | None = None
    building: bool = False
    error: str = ""
    stopped: bool = False

    # What is there once a request was asked for, or is being shown

    @property
    def folder_path(self) -> Path:
        assert self.folder is not None
        return self.folder

    @property
    def subject_path(self) -> Path:
        assert self.subject is not None
        return self.subject

    @property
    def loading_path(self) -> Path:
        assert self.loading is not None
        return self.loading

    @property
    def place(self) -> Path:
        """Folder of what the request makes."""
        return self.folder_path.parent

    @property
    def run(self) -> Path:
        """Folder of the run that it trains."""
        return self.place / RUN_FOLDER if self.kind == Kind.AVATAR else self.place

    @property
    def interval_s(self) -> float | None:
        """Seconds until the next check; None: nothing is expected any more, the timer can stop."""
        if self.folder is None or self.stopped:
            return None
        if self.building:
            return SLICE_INTERVAL_S
        is_expected = self.snapshot.state.is_alive or self.loading is not None or self.has_result
        return CHECK_INTERVAL_S if is_expected else None

    @property
    def has_result(self) -> bool:
        """Whether the worker has ended with a result that is still to be shown."""
        # An avatar's tracking may have been cancelled; a video changes nothing in the scene.
        if self.kind == Kind.VIDEO or (self.kind == Kind.AVATAR and self.files.avatar is None):
            return False
        state = self.snapshot.state
        is_kept = state == WorkerState.CANCELLED and self.kind in TRAINS
        return (is_kept or state == WorkerState.FINISHED) and not self.result_shown

    @property
    def is_running(self) -> bool:
        """Whether it can be cancelled, and another request of the kind has to wait."""
        return self.snapshot.state.is_alive or (self.kind in TRANSIENT and self.folder is not None)

    @property
    def can_be_dismissed(self) -> bool:
        return self.kind in DISMISSIBLE and self.subject is not None and not self.is_running


# Events


@dataclass(frozen=True)
class Started:
    """A worker was started for a request in this folder."""

    subject: Path
    folder: Path


@dataclass(frozen=True)
class CancelAsked:
    """The user cancels the request."""


@dataclass(frozen=True)
class Dismissed:
    """The user dismisses what is said about the request's end."""


@dataclass(frozen=True)
class SceneRead:
    """What the scene stores. What an undo step took back is stored again."""

    subject: Path | None
    result_shown: bool


@dataclass(frozen=True)
class StatusRead:
    """The request's folder was read. live_preview, show_result: what the user wants to see."""

    folder: Path
    snapshot: WorkerSnapshot
    files: RunFiles = field(default_factory=RunFiles)
    live_preview: bool = True
    show_result: bool = True


@dataclass(frozen=True)
class SceneFree:
    """The result can be shown: nothing renders, and none of its objects is in Edit Mode."""


@dataclass(frozen=True)
class SliceBuilt:
    """A slice of what is shown was built, others remain."""


@dataclass(frozen=True)
class Displayed:
    """What was loaded is in the scene. undoable: with a change that deserves an undo step."""

    undoable: bool = False


@dataclass(frozen=True)
class Failed:
    """What was loaded cannot be shown; stops: nor can the request be monitored any more."""

    sentence: str
    stops: bool = False


Event = (
    Started
    | CancelAsked
    | Dismissed
    | SceneRead
    | StatusRead
    | SceneFree
    | SliceBuilt
    | Displayed
    | Failed
)


# Effects


@dataclass(frozen=True)
class Store:
    """Store the subject, and whether its result was shown, in the scene."""

    subject: Path | None
    result_shown: bool


@dataclass(frozen=True)
class _OnPath:
    """An effect on one file or folder."""

    path: Path


class StoreAvatar(_OnPath):
    """Store the path of the trained avatar in the scene."""


class LoadAvatar(_OnPath):
    """Read an avatar file in a thread."""


class Show(_OnPath):
    """Put what was loaded and read into the scene; answered by SliceBuilt, Displayed or Failed."""


class ReadCurve(_OnPath):
    """Read the run's evaluations for the panel's curve, before them the tracking's picture."""


class StopWorker(_OnPath):
    """Ask the worker of the request in this folder to stop and to keep what it has."""


class KillWorker(_OnPath):
    """End the worker of the request in this folder at once."""


class RemoveFiles(_OnPath):
    """Remove the request's folder; what the request has made stays."""


@dataclass(frozen=True)
class PushUndo:
    """Add an undo step."""


@dataclass(frozen=True)
class Redraw:
    """Redraw the panels."""


Effect = (
    Store
    | StoreAvatar
    | LoadAvatar
    | Show
    | ReadCurve
    | StopWorker
    | KillWorker
    | RemoveFiles
    | PushUndo
    | Redraw
)
Outcome = tuple[RequestState, tuple[Effect, ...]]


def transition(state: RequestState, event: Event) -> Outcome:
    """The state after an event, and the effects to carry out in this order."""
    match event:
        case Started(subject, folder):
            return _started(state, subject, folder)
        case CancelAsked() if state.kind in TRANSIENT:
            return _without_request(state, KillWorker(state.folder) if state.folder else None)
        case CancelAsked():
            return state, (StopWorker(state.folder),) if state.folder else ()
        case Dismissed():
            return _without_request(state)
        case SceneRead(subject, result_shown):
            is_stored = (subject, result_shown) == (state.subject, state.result_shown)
            return state, () if is_stored else _stored(state)
        case StatusRead():
            return _status_read(state, event)
        case SceneFree():
            return state, () if state.loading is None else (Show(state.loading),)
        case SliceBuilt():
            return replace(state, building=True), ()
        case Displayed(undoable):
            return _loading_ended(state, undoable)
        case Failed(sentence, stops=True):
            state = replace(state, error=sentence, stopped=True, loading=None, building=False)
            return state, (Redraw(),)
        case Failed(sentence):
            return _loading_ended(state, error=sentence)


def _stored(state: RequestState) -> tuple[Effect, ...]:
    return (Store(state.subject, state.result_shown),) if state.kind in STORED else ()


def _started(before: RequestState, subject: Path, folder: Path) -> Outcome:
    state = RequestState(before.kind, subject, folder)
    is_stale = before.kind == Kind.VIDEO and before.folder not in (None, folder)
    stale = (RemoveFiles(before.folder),) if is_stale and before.folder else ()
    curve = (ReadCurve(state.run),) if state.kind in TRAINS else ()
    return state, (*stale, *_stored(state), *curve, Redraw())


def _without_request(state: RequestState, first: Effect | None = None, error: str = "") -> Outcome:
    """The state without its request, whose folder is removed."""
    empty = RequestState(state.kind, error=error)
    removed = (RemoveFiles(state.folder),) if state.folder is not None else ()
    return empty, (*((first,) if first else ()), *removed, *_stored(empty), Redraw())


def _status_read(state: RequestState, event: StatusRead) -> Outcome:
    effects: list[Effect] = []
    before = state
    error = "" if state.stopped else state.error
    state = replace(
        state,
        folder=event.folder,
        files=event.files,
        snapshot=event.snapshot,
        error=error,
        stopped=False,
    )
    if event.snapshot.state == WorkerState.NONE and event.files.avatar is not None:
        return _without_request(state)  # dismissed since the file was saved
    drawn = [(each.folder, each.files.metrics, each.files.picture) for each in (before, state)]
    if drawn[0] != drawn[1] and state.kind in (*TRAINS, Kind.TRACKING):
        effects.append(ReadCurve(state.run))
    snapshots = [(each.folder, each.files, each.snapshot) for each in (before, state)]
    if snapshots[0] != snapshots[1]:
        effects.append(Redraw())
    is_alive = state.snapshot.state.is_alive
    files = state.files
    if state.loading is not None:
        return state, tuple(effects)
    if state.kind not in TRAINS:
        if state.has_result:
            state = replace(state, loading=state.folder)
        elif state.kind in TRANSIENT and not is_alive:
            # The panel has no options of the command line.
            return _without_request(
                state, error=state.snapshot.status.error.removeprefix("--effect ")
            )
        return state, tuple(effects)
    # the tracked capture, the trained avatar, or a preview of it, once each
    if files.capture not in (None, state.displayed_capture) and (is_alive or state.has_result):
        tracked = state.place / CAPTURE_FOLDER
        return replace(state, loading=tracked, displayed_capture=files.capture), tuple(effects)
    if state.has_result:
        effects.append(StoreAvatar(state.run / AVATAR))
        if event.show_result:
            state = replace(state, loading=state.run / AVATAR)
        else:
            state = replace(state, result_shown=True)
            effects.extend(_stored(state))
    elif is_alive and event.live_preview and files.preview not in (None, state.displayed_preview):
        state = replace(state, loading=event.folder / PREVIEW, displayed_preview=files.preview)
    if state.loading is not None:
        effects.append(LoadAvatar(state.loading))
    return state, tuple(effects)


def _loading_ended(state: RequestState, undoable: bool = False, error: str = "") -> Outcome:
    loading = state.loading
    was_result = loading is not None and (state.kind not in TRAINS or loading.name == AVATAR)
    # Undo brings back what was shown before the training.
    undoable = undoable or (state.kind in TRAINS and was_result and not error)
    undo = (PushUndo(),) if undoable else ()
    if state.kind in TRANSIENT:
        cleared, removed = _without_request(state, error=error)
        return cleared, (*undo, *removed)
    state = replace(
        state,
        loading=None,
        building=False,
        error=error,
        result_shown=state.result_shown or was_result,
    )
    return state, (*(_stored(state) if was_result else ()), *undo, Redraw())
