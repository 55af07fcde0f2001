"""State of a scene's training: transitions without Blender."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from stga_addon.requests.monitor_state import (
    CHECK_INTERVAL_S,
    SLICE_INTERVAL_S,
    AvatarFailed,
    AvatarShown,
    Dismissed,
    Effect,
    Event,
    FileLoaded,
    LoadAvatar,
    MonitorFailed,
    MonitorState,
    PushUndo,
    ReadCurve,
    Redraw,
    RunFiles,
    SceneRead,
    SliceBuilt,
    Started,
    StatusRead,
    StoreAvatar,
    StoreTraining,
    transition,
)
from stga_addon.worker.status import WorkerSnapshot, WorkerState

RUN = Path("run")
PREVIEW = RUN / "job/preview.npz"
AVATAR = RUN / "avatar.npz"


def after(*events: Event, state: MonitorState | None = None) -> tuple[MonitorState, list[Effect]]:
    """The state after the events, and the effects of the last one."""
    effects: Sequence[Effect] = ()
    state = state or MonitorState()
    for event in events:
        state, effects = transition(state, event)
    return state, list(effects)


def status(state: WorkerState, preview: int = 0, folder: Path = RUN, **wanted: bool) -> StatusRead:
    """A status that was read; preview: stamp of the preview file, 0: there is none."""
    files = RunFiles(preview=(preview, 1) if preview else None)
    return StatusRead(folder, WorkerSnapshot(state), files, **wanted)


def loads(effects: list[Effect]) -> list[Path]:
    return [effect.path for effect in effects if isinstance(effect, LoadAvatar)]


def test_start_is_stored_and_monitored():
    """Catches a training that the .blend file forgets, or that keeps the state of the one before."""
    before = MonitorState(Path("old"), Path("old"), result_shown=True, error="old", stopped=True)
    state, effects = after(Started(RUN), state=before)
    assert state == MonitorState(RUN, RUN)
    assert effects == [StoreTraining(RUN, False), ReadCurve(RUN), Redraw()]


def test_each_preview_is_loaded_once():
    """Catches previews that are read again at every check, and later ones that are not shown."""
    state, effects = after(Started(RUN), status(WorkerState.WORKING, preview=1))
    assert loads(effects) == [PREVIEW]
    state, effects = after(status(WorkerState.WORKING, preview=2), state=state)
    assert not loads(effects), "the preview before is still being read"
    state, effects = after(AvatarShown(created=True), state=state)
    assert effects == [PushUndo(), Redraw()]
    state, effects = after(status(WorkerState.WORKING, preview=2), state=state)
    assert loads(effects) == [PREVIEW]
    state, effects = after(AvatarShown(created=False), status(WorkerState.WORKING, preview=2), state=state)
    assert effects == []
    assert state.interval_s == CHECK_INTERVAL_S


def test_no_preview_unless_wanted():
    """Catches splats that keep changing although live preview is off, and a preview that is lost by turning it on."""
    state, effects = after(Started(RUN), status(WorkerState.WORKING, preview=1, live_preview=False))
    assert not loads(effects)
    assert loads(after(status(WorkerState.WORKING, preview=1), state=state)[1]) == [PREVIEW]


@pytest.mark.parametrize("end", [WorkerState.FINISHED, WorkerState.CANCELLED])
def test_result_is_shown_once(end):
    """Catches a result that is not shown, or shown again at every check, or that undo cannot take back."""
    state, effects = after(Started(RUN), status(end))
    assert StoreAvatar(AVATAR) in effects
    assert loads(effects) == [AVATAR]
    assert state.interval_s == CHECK_INTERVAL_S
    state, effects = after(AvatarShown(created=False), state=state)
    assert effects == [StoreTraining(RUN, True), PushUndo(), Redraw()]
    assert state.interval_s is None
    assert after(status(end), state=state) == (state, [])


def test_result_that_is_not_wanted_is_only_stored():
    """Catches splats that appear although the user turned that off."""
    state, effects = after(Started(RUN), status(WorkerState.FINISHED, show_result=False))
    assert not loads(effects)
    assert {StoreAvatar(AVATAR), StoreTraining(RUN, True)} <= set(effects)
    assert state.result_shown
    assert state.interval_s is None


def test_result_waits_for_the_preview_that_is_being_built():
    """Catches two avatars that are built at the same time."""
    state, effects = after(
        Started(RUN), status(WorkerState.WORKING, preview=1), SliceBuilt(), status(WorkerState.FINISHED, preview=1)
    )
    assert not loads(effects)
    assert state.interval_s == SLICE_INTERVAL_S
    _, effects = after(AvatarShown(created=True), status(WorkerState.FINISHED, preview=1), state=state)
    assert loads(effects) == [AVATAR]


def test_avatar_that_cannot_be_shown_is_reported():
    """Catches a failure that nobody sees, and one that is tried again for ever."""
    state, effects = after(Started(RUN), status(WorkerState.FINISHED), AvatarFailed("no head"))
    assert (state.error, state.result_shown, state.interval_s) == ("no head", True, None)
    assert effects == [StoreTraining(RUN, True), Redraw()]
    state, _ = after(Started(RUN), status(WorkerState.WORKING, preview=1), AvatarFailed("no head"))
    assert (state.error, state.result_shown, state.interval_s) == ("no head", False, CHECK_INTERVAL_S)


@pytest.mark.parametrize("end", [WorkerState.FAILED, WorkerState.LOST, WorkerState.NONE])
def test_failure_ends_the_timer(end):
    """Catches a timer that runs for ever, and an avatar that is shown of a training that failed."""
    state, effects = after(Started(RUN), status(WorkerState.WORKING), status(end))
    assert effects == [Redraw()]
    assert state.interval_s is None
    assert not state.result_shown


def test_undo_does_not_lose_the_training():
    """Catches a training that nobody can cancel because an undo step took the scene back to before it began."""
    state, _ = after(Started(RUN), status(WorkerState.WORKING))
    assert after(SceneRead(None, False), state=state) == (state, [StoreTraining(RUN, False)])
    assert after(SceneRead(RUN, False), state=state) == (state, [])


def test_undo_does_not_show_the_result_again():
    """Catches an undo of the shown splats that the next check reverts."""
    state, _ = after(Started(RUN), status(WorkerState.FINISHED), AvatarShown(created=True))
    state, effects = after(SceneRead(RUN, False), state=state)
    assert effects == [StoreTraining(RUN, True)]
    assert after(status(WorkerState.FINISHED), state=state) == (state, [])


def test_undo_does_not_bring_back_what_was_dismissed():
    """Catches a dismissed training that returns as one whose folder is missing."""
    state, effects = after(Started(RUN), status(WorkerState.FINISHED), Dismissed())
    assert effects == [StoreTraining(None, False), Redraw()]
    assert state.interval_s is None
    assert after(SceneRead(RUN, True), state=state)[1] == [StoreTraining(None, False)]


def test_loaded_file_continues():
    """Catches a worker that is not found again after reopening, and a result that is shown again then."""
    state, _ = after(FileLoaded(RUN, False), status(WorkerState.WORKING))
    assert state.interval_s == CHECK_INTERVAL_S
    assert loads(after(FileLoaded(RUN, False), status(WorkerState.FINISHED))[1]) == [AVATAR]
    assert not loads(after(FileLoaded(RUN, True), status(WorkerState.FINISHED))[1])
    assert after(FileLoaded(None, False))[0].interval_s is None


def test_moved_run_folder():
    """Catches a result read from the old place, and splats that the scene no longer recognizes as this run's."""
    moved = Path("elsewhere/run")
    state, effects = after(FileLoaded(RUN, False), status(WorkerState.FINISHED, folder=moved))
    assert loads(effects) == [moved / "avatar.npz"]
    assert ReadCurve(moved) in effects
    assert (state.run, state.folder) == (RUN, moved)


def test_curve_is_read_when_it_grows():
    """Catches a curve that is read at every check, or never again."""
    first = StatusRead(RUN, WorkerSnapshot(WorkerState.WORKING), RunFiles(metrics=(1, 1)))
    second = StatusRead(RUN, WorkerSnapshot(WorkerState.WORKING), RunFiles(metrics=(2, 2)))
    state, effects = after(Started(RUN), first)
    assert ReadCurve(RUN) in effects
    assert after(first, state=state)[1] == []
    assert ReadCurve(RUN) in after(second, state=state)[1]


def test_unexpected_error_stops_until_the_next_start_or_check():
    """Catches a timer that ends silently, one that repeats the same traceback, and one that never recovers."""
    state, effects = after(Started(RUN), status(WorkerState.WORKING, preview=1), MonitorFailed("a bug"))
    assert (state.error, state.interval_s, effects) == ("a bug", None, [Redraw()])
    for restart in (Started(RUN), status(WorkerState.WORKING)):
        restarted, _ = after(restart, status(WorkerState.WORKING), state=state)
        assert (restarted.interval_s, restarted.error) == (CHECK_INTERVAL_S, "")


def test_training_that_ends_while_a_preview_is_shown():
    """Catches checks that end with the worker, so that its last avatar never reaches the scene."""
    state, _ = after(Started(RUN), status(WorkerState.WORKING, preview=1), status(WorkerState.CANCELLED, preview=1))
    state, _ = after(AvatarShown(created=False), state=state)
    assert state.interval_s == CHECK_INTERVAL_S
    state, effects = after(status(WorkerState.CANCELLED, preview=1), state=state)
    assert loads(effects) == [AVATAR]
    state, _ = after(AvatarShown(created=False), state=state)
    assert state.result_shown
    assert state.interval_s is None
