"""State of a request that Blender follows: transitions without Blender."""

from dataclasses import replace
from pathlib import Path

import pytest

from stga_addon.jobs.monitor_state import (
    CHECK_INTERVAL_S,
    SLICE_INTERVAL_S,
    CancelAsked,
    Dismissed,
    Displayed,
    Failed,
    KillWorker,
    LoadAvatar,
    PushUndo,
    ReadCurve,
    Redraw,
    RemoveFiles,
    RequestState,
    RunFiles,
    SceneFree,
    SceneRead,
    Show,
    SliceBuilt,
    Started,
    StatusRead,
    StopWorker,
    Store,
    StoreAvatar,
    transition,
)
from stga_addon.jobs.table import DISMISSIBLE, Kind
from stga_addon.worker.status import WorkerSnapshot, WorkerState, WorkerStatus

RUN = Path("run")
JOB = RUN / "job"
PREVIEW = JOB / "preview.npz"
AVATAR = RUN / "avatar.npz"
START = Started(RUN, JOB)
TRANSIENT = Kind.ANALYSIS, Kind.PERFORMANCE, Kind.LIGHT, Kind.EXACT
"""What leaves nothing but its result in the scene."""
ENDS = (WorkerState.FINISHED, WorkerState.CANCELLED, WorkerState.FAILED, WorkerState.LOST)
TRAINING = RequestState(Kind.TRAINING)


def after(*events, state=TRAINING):
    """The state after the events, and the effects of the last one."""
    effects = ()
    for event in events:
        state, effects = transition(state, event)
    return state, list(effects)


def status(state, preview=0, folder=JOB, error="", **wanted):
    """A status that was read; preview: stamp of the preview file, 0: there is none."""
    files = RunFiles(preview=(preview, 1) if preview else None)
    return StatusRead(folder, WorkerSnapshot(state, WorkerStatus(error=error)), files, **wanted)


def loads(effects):
    return [effect.path for effect in effects if isinstance(effect, LoadAvatar)]


# Any request


@pytest.mark.parametrize("kind", Kind)
def test_a_running_request_of_any_kind(kind):
    """Catches progress that is not seen or followed, and a second request beside a running one."""
    state, effects = after(
        START, state=RequestState(kind, Path("old"), JOB, error="old", stopped=True)
    )
    assert state == RequestState(kind, RUN, JOB)
    assert Redraw() in effects
    assert (Store(RUN, False) in effects) == (kind in (Kind.TRAINING, Kind.TRACKING, Kind.AVATAR))
    for worker in (WorkerState.STARTING, WorkerState.WORKING, WorkerState.CANCELLING):
        state, effects = after(status(worker), state=state)
        assert state.is_running
        assert state.interval_s == CHECK_INTERVAL_S
        assert not state.can_be_dismissed
        assert effects == [Redraw()]
    assert after(status(WorkerState.CANCELLING), state=state) == (state, [])


@pytest.mark.parametrize("kind", Kind)
@pytest.mark.parametrize("end", ENDS)
def test_any_end_of_any_kind_stops_the_timer(kind, end):
    """Catches a timer that runs for ever, and a result shown twice or after a failure."""
    events = START, status(WorkerState.WORKING), status(end, error="--effect why")
    state, _ = after(*events, state=RequestState(kind))
    shown = {Kind.TRAINING: ENDS[:2], Kind.VIDEO: (), Kind.AVATAR: ()}.get(kind, ENDS[:1])
    assert (state.loading is not None) == (end in shown)
    if state.loading is not None:
        assert state.interval_s == CHECK_INTERVAL_S
        assert after(SceneFree(), state=state) == (state, [Show(state.loading)])
        state, _ = after(Displayed(), state=state)
    assert (state.interval_s, state.is_running, state.loading) == (None, False, None)
    assert after(SceneFree(), state=state) == (state, [])
    assert state.can_be_dismissed == (kind in DISMISSIBLE)
    transient = kind in TRANSIENT
    assert (state.error == "why") == (transient and end not in shown)


@pytest.mark.parametrize("kind", Kind)
def test_cancel_and_dismiss(kind):
    """Catches a cancel that throws work away or waits, and files or names of what was dismissed."""
    idle, effects = after(CancelAsked(), state=RequestState(kind))
    assert not {StopWorker(JOB), KillWorker(JOB), RemoveFiles(JOB)} & {*effects}
    running, _ = after(START, status(WorkerState.WORKING), state=RequestState(kind))
    state, effects = after(CancelAsked(), state=running)
    if kind in TRANSIENT:
        assert state == idle
        assert effects == [KillWorker(JOB), RemoveFiles(JOB), Redraw()]
    else:
        assert (state, effects) == (running, [StopWorker(JOB)])
    failed = START, status(WorkerState.FAILED), Dismissed()
    state, effects = after(*failed, state=RequestState(kind))
    if kind in DISMISSIBLE:
        assert state == RequestState(kind)
        stored = [] if kind == Kind.VIDEO else [Store(None, False)]
        assert effects == [RemoveFiles(JOB), *stored, Redraw()]


@pytest.mark.parametrize("kind", [Kind.TRAINING, Kind.TRACKING, *TRANSIENT])
def test_a_result_that_cannot_be_shown(kind):
    """Catches a failure that nobody sees or is tried for ever, and a mesh changed in Edit Mode."""
    failed = START, status(WorkerState.FINISHED), Failed("no head")
    state, effects = after(*failed, state=RequestState(kind))
    assert (state.error, state.interval_s, state.is_running) == ("no head", None, False)
    assert PushUndo() not in effects
    done = RemoveFiles(JOB) if kind in TRANSIENT else Store(RUN, True)
    assert done in effects
    if kind == Kind.TRAINING:  # whose previews are built in slices
        return
    state, effects = after(START, status(WorkerState.FINISHED), state=RequestState(kind))
    for _ in range(3):
        assert not any(isinstance(effect, Show) for effect in effects)
        state, effects = after(status(WorkerState.FINISHED), state=state)
        assert state.interval_s == CHECK_INTERVAL_S
    assert state.is_running == (kind != Kind.TRACKING)


def test_the_next_video_replaces_the_last_one():
    """Catches a folder left for each video, and a recording removed when its worker starts."""
    first, _ = after(START, status(WorkerState.FINISHED), state=RequestState(Kind.VIDEO))
    _, effects = after(Started(RUN, Path("next")), state=first)
    assert RemoveFiles(JOB) in effects
    _, effects = after(Started(RUN, JOB), state=first)
    assert RemoveFiles(JOB) not in effects


# Trainings


def test_each_preview_is_loaded_once():
    """Catches previews read again, lost, unwanted, or built at the same time as another avatar."""
    state, effects = after(START, status(WorkerState.WORKING, preview=1, live_preview=False))
    assert not loads(effects)
    state, effects = after(status(WorkerState.WORKING, preview=1), state=state)
    assert loads(effects) == [PREVIEW]
    state, effects = after(status(WorkerState.WORKING, preview=2), state=state)
    assert not loads(effects), "the preview before is still being read"
    state, effects = after(Displayed(undoable=True), state=state)
    assert effects == [PushUndo(), Redraw()]
    state, effects = after(status(WorkerState.WORKING, preview=2), state=state)
    assert loads(effects) == [PREVIEW]
    state, effects = after(Displayed(), status(WorkerState.WORKING, preview=2), state=state)
    assert effects == []
    assert state.interval_s == CHECK_INTERVAL_S
    state, effects = after(
        START,
        status(WorkerState.WORKING, preview=1),
        SliceBuilt(),
        status(WorkerState.FINISHED, preview=1),
    )
    assert not loads(effects)
    assert state.interval_s == SLICE_INTERVAL_S
    assert after(SceneFree(), state=state)[1] == [Show(PREVIEW)]
    _, effects = after(
        Displayed(undoable=True), status(WorkerState.FINISHED, preview=1), state=state
    )
    assert loads(effects) == [AVATAR]


@pytest.mark.parametrize("end", [WorkerState.FINISHED, WorkerState.CANCELLED])
def test_result_is_shown_once(end):
    """Catches a result not shown, shown again or unwanted, not undoable, or lost by reopening."""
    state, effects = after(START, status(end, show_result=False))
    assert not loads(effects)
    assert {StoreAvatar(AVATAR), Store(RUN, True)} <= set(effects)
    assert (state.result_shown, state.interval_s) == (True, None)
    state, effects = after(START, status(end))
    assert StoreAvatar(AVATAR) in effects
    assert loads(effects) == [AVATAR]
    state, effects = after(Displayed(), state=state)
    assert effects == [Store(RUN, True), PushUndo(), Redraw()]
    assert state.interval_s is None
    assert after(status(end), state=state) == (state, [])
    loaded = RequestState(Kind.TRAINING, RUN, JOB)
    assert after(status(WorkerState.WORKING), state=loaded)[0].interval_s == CHECK_INTERVAL_S
    assert loads(after(status(WorkerState.FINISHED), state=loaded)[1]) == [AVATAR]
    shown = replace(loaded, result_shown=True)
    assert not loads(after(status(WorkerState.FINISHED), state=shown)[1])
    assert TRAINING.interval_s is None


def test_undo():
    """Catches a training that undo takes from the scene for good, and undone splats that return."""
    state, _ = after(START, status(WorkerState.WORKING))
    assert after(SceneRead(None, False), state=state) == (state, [Store(RUN, False)])
    assert after(SceneRead(RUN, False), state=state) == (state, [])
    state, _ = after(status(WorkerState.FINISHED), Displayed(undoable=True), state=state)
    assert after(SceneRead(RUN, False), state=state) == (state, [Store(RUN, True)])
    assert after(status(WorkerState.FINISHED), state=state) == (state, [])
    _, effects = after(Dismissed(), SceneRead(RUN, True), state=state)
    assert effects == [Store(None, False)]
    events = START, status(WorkerState.FINISHED), Displayed(undoable=True)
    _, effects = after(*events, state=RequestState(Kind.PERFORMANCE))
    assert effects == [PushUndo(), RemoveFiles(JOB), Redraw()]


def test_moved_run_folder():
    """Catches a result read from the old place, and splats no longer known as this run's."""
    moved = Path("elsewhere/run")
    state, effects = after(START, status(WorkerState.FINISHED, folder=moved / "job"))
    assert loads(effects) == [moved / "avatar.npz"]
    assert ReadCurve(moved) in effects
    assert (state.subject, state.place) == (RUN, moved)


@pytest.mark.parametrize("kind", [Kind.TRAINING, Kind.AVATAR])
def test_dismissed_since_the_file_was_saved(kind):
    """Catches "run not found" over a run that is there, and one that is not, forgotten."""
    stored = RequestState(kind, RUN, JOB, result_shown=True)
    read = made(WorkerState.NONE, avatar=1)
    state, effects = after(read, state=stored)
    assert (state, Store(None, False) in effects) == (RequestState(kind), True)
    assert after(made(WorkerState.NONE), state=stored)[0].subject == RUN


def test_unexpected_error_stops_until_the_next_start_or_check():
    """Catches a timer that ends silently, repeats a traceback, or never recovers."""
    state, effects = after(
        START, status(WorkerState.WORKING, preview=1), Failed("a bug", stops=True)
    )
    assert (state.error, state.interval_s, effects) == ("a bug", None, [Redraw()])
    for restart in (START, status(WorkerState.WORKING)):
        restarted, _ = after(restart, status(WorkerState.WORKING), state=state)
        assert (restarted.interval_s, restarted.error) == (CHECK_INTERVAL_S, "")


# An avatar from footage


def made(state, **files):
    """A status of making an avatar; files: name -> stamp."""
    stamps = {name: (stamp, 1) for name, stamp in files.items()}
    return StatusRead(JOB, WorkerSnapshot(state), RunFiles(**stamps))


def test_head_previews_and_avatar_appear_once_each():
    """Catches a head imported anew or never, and an avatar of another folder or request."""
    making = RequestState(Kind.AVATAR)
    state, _ = after(START, made(WorkerState.WORKING), state=making)
    assert state.loading is None
    state, effects = after(made(WorkerState.WORKING, capture=1, preview=1), state=state)
    assert (state.loading, loads(effects)) == (RUN / "capture", [])
    again = Displayed(), made(WorkerState.WORKING, capture=1, preview=1)
    state, effects = after(*again, state=state)
    assert loads(effects) == [PREVIEW]
    state, effects = after(*again, state=state)
    assert (state.loading, loads(effects)) == (None, [])
    last = made(WorkerState.FINISHED, capture=1, preview=1, avatar=1)
    state, effects = after(last, state=state)
    assert loads(effects) == [RUN / "run" / "avatar.npz"]
    assert StoreAvatar(RUN / "run" / "avatar.npz") in effects
    state, effects = after(Displayed(), state=state)
    assert {PushUndo(), Store(RUN, True)} <= set(effects)
    assert state.interval_s is None
    assert after(last, state=state)[0].loading is None
    for end in (WorkerState.CANCELLED, WorkerState.FAILED):
        state, effects = after(START, made(end, capture=1), state=making)
        assert (state.loading, loads(effects), state.interval_s) == (None, [], None)


@pytest.mark.parametrize(
    ("kind", "file", "run"),
    [(Kind.TRAINING, "metrics", RUN), (Kind.AVATAR, "picture", RUN / "run")],
)
def test_the_curve_or_picture_is_read_when_it_grows(kind, file, run):
    """Catches a curve or picture that is read at every check, or never again."""
    state, _ = after(START, made(WorkerState.WORKING), state=RequestState(kind))
    for stamp in (1, 2):
        state, effects = after(made(WorkerState.WORKING, **{file: stamp}), state=state)
        assert ReadCurve(run) in effects
    assert after(made(WorkerState.WORKING, **{file: 2}), state=state)[1] == []
