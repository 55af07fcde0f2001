"""Request monitor: the one timer, which reads the status of workers and brings their results into
their scenes.

What is to be done is decided by `jobs.monitor_state`; this module reads files, owns the timer and
carries out effects, those that depend on the kind of request by the table in `results`.
"""

import shutil
import traceback
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from subprocess import Popen
from time import monotonic, sleep
from typing import Any, Protocol

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..stga_addon.errors import StgaError
from ..stga_addon.files import read_npz
from ..stga_addon.jobs import monitor_state as states
from ..stga_addon.jobs.monitor_state import (
    CHECK_INTERVAL_S,
    SLICE_INTERVAL_S,
    RequestState,
    RunFiles,
    transition,
)
from ..stga_addon.jobs.perform import PICTURE, PREVIEW, remove_request, request_folder
from ..stga_addon.jobs.table import STORED, TRANSIENT, Kind
from ..stga_addon.jobs.track import CAPTURE_FOLDER, RUN_FOLDER
from ..stga_addon.report import curve_image
from ..stga_addon.scene import tags
from ..stga_addon.scene.avatar_scene import open_sidebar
from ..stga_addon.scene.compat import APPENDED
from ..stga_addon.tracking.folder import SPLIT_FILES
from ..stga_addon.training.run.folder import AVATAR, TRACKING, has_run
from ..stga_addon.training.run.metrics_log import METRICS, read_metrics
from ..stga_addon.worker.status import (
    WorkerSnapshot,
    inspect_worker,
    refuse_running_worker,
    request_cancel,
)
from . import ids
from .common import is_head
from .results import IN_SCENE, loader
from .show import run_of

Curve = tuple[np.ndarray, str, str]
"""Pixels of a run's curve, the ranges of its axes and of the detail difference; or those of a
tracking's picture."""

_states: dict[tuple[int, Kind], RequestState] = {}
"""Session id of a scene and kind -> its request."""
_curves: dict[Path, Curve | None] = {}
"""Run or capture folder -> its curve as last read."""
_processes: dict[Path, "Popen[bytes]"] = {}
"""Folder of a request -> worker that this Blender started, whose exit code is known."""


class Watched(Protocol):
    """What the timer calls beside its checks of requests, at a rate of its own."""

    def tick(self) -> float | None:
        """Seconds until the next call; None where there is none."""

    def close(self) -> None:
        """The file, or the extension, is gone."""


_watched: list[Watched] = []
_requests_due = 0.0
"""Monotonic time of the next check of requests, while something is called more often."""


def watch(thing: Watched) -> None:
    """Call `thing` from the timer until it returns None, the file is closed, or the extension
    ends."""
    _watched.append(thing)
    _restart_timer()


def unwatch(thing: Watched) -> None:
    """Call it no more; without an effect where it is not called."""
    with suppress(ValueError):
        _watched.remove(thing)


def state_of(scene: Any, kind: Kind) -> RequestState:
    """The scene's request as the timer last saw it; without a window, where no timer runs, as it
    is."""
    state = _states.get(_key(scene, kind))
    if has_timer():
        if state is None:
            _start_timer()
        return state or RequestState(kind)
    state = state or _stored_state(scene, kind)
    if state.folder is None:
        return state
    folder = _locate(scene, state)
    return replace(state, folder=folder, snapshot=inspect_status(folder))


def curve(run: Path) -> Curve | None:
    """The curve of a run as the timer last read it, or the picture of a tracking; None before there
    is one."""
    return _curves.get(run)


def follow(
    scene: Any, kind: Kind, subject: Path, folder: Path, process: "Popen[bytes] | None" = None
) -> None:
    """The request in the folder is that of the scene. process: its worker; None: this process
    carries it out."""
    _processes.pop(folder, None)
    if process is not None:
        _processes[folder] = process
    _handle(scene, kind, states.Started(subject, folder))


def finish(scene: Any, kind: Kind) -> RequestState:
    """Bring the result of a request that was waited for into the scene; what `Train` made is
    stored, not shown."""
    state = _handle(
        scene, kind, _read_status(scene, _states[_key(scene, kind)], kind != Kind.TRAINING)
    )
    while state.loading is not None:
        state = _handle(scene, kind, states.SceneFree())
        if state.loading is not None:
            sleep(SLICE_INTERVAL_S)
        elif state.has_result:
            state = _handle(scene, kind, _read_status(scene, state, True))
    return state


def cancel(scene: Any, kind: Kind) -> None:
    """Raises StgaError where the request's folder cannot be written."""
    _handle(scene, kind, states.CancelAsked())
    check_now(scene, kind)


def dismiss(scene: Any, kind: Kind) -> None:
    """Forget the request and remove its files. Raises StgaError where its worker is running, or
    they cannot be."""
    _handle(scene, kind, states.Dismissed())


def check_now(scene: Any, kind: Kind) -> None:
    """Read the status of a request at once, and again as long as something is expected."""
    state = _read_scene(scene, kind)
    if state.folder is not None:
        _handle(scene, kind, _read_status(scene, state))
    _start_timer()


def inspect_status(folder: Path) -> WorkerSnapshot:
    """Status of a worker as it is now, with its exit code where this Blender started it."""
    return inspect_worker(folder, _processes.get(folder))


def has_timer() -> bool:
    """Whether Blender has a window, and so runs timers."""
    return not bpy.app.background


def tick() -> float | None:
    """Check every request, and call what is watched; seconds until the next call, None to stop the
    timer, as bpy.app.timers expects."""
    intervals = [_check_requests(), *(_call_safely(thing) for thing in list(_watched))]
    return min((interval for interval in intervals if interval is not None), default=None)


def _check_requests() -> float | None:
    """Check every request, unless the timer runs faster for something else and it is too early;
    seconds until the next check, None where nothing is expected."""
    global _requests_due
    now = monotonic()
    if _watched and now < _requests_due:
        return _requests_due - now
    scenes = [scene for scene in bpy.data.scenes if scene.library is None]
    intervals = [_check_safely(scene, kind) for scene in scenes for kind in Kind]
    interval = min((interval for interval in intervals if interval is not None), default=None)
    _requests_due = now + (CHECK_INTERVAL_S if interval is None else interval)
    return interval


def _call_safely(thing: Watched) -> float | None:
    """Call what is watched; after an unexpected error, which is reported, it is closed and called
    no more."""
    try:
        interval = thing.tick()
    except Exception as error:
        print(_describe(error))
        thing.close()
        interval = None
    if interval is None:
        unwatch(thing)
    return interval


def _check_safely(scene: Any, kind: Kind) -> float | None:
    """Check one request; an unexpected error is reported once, and ends the monitoring of this
    request only."""
    try:
        return _check(scene, kind)
    except Exception as error:
        _handle(
            scene,
            kind,
            states.Failed(f"Monitoring stopped after an unexpected {_describe(error)}", stops=True),
        )
        return None


def _check(scene: Any, kind: Kind) -> float | None:
    state = _read_scene(scene, kind)
    if state.folder is None or state.stopped:
        return None
    if not state.building:
        state = _handle(scene, kind, _read_status(scene, state))
    # Blender crashes where a mesh changes during these.
    if (
        state.loading is not None
        and not bpy.app.is_job_running("RENDER")
        and not _is_edited(scene, kind)
    ):
        state = _handle(scene, kind, states.SceneFree())
    return state.interval_s


def _describe(error: Exception) -> str:
    """Print the traceback of an error that is being handled; its description for a sentence."""
    traceback.print_exc()
    return f"error ({type(error).__name__}: {error}); see the console"


def _key(scene: Any, kind: Kind) -> tuple[int, Kind]:
    return scene.session_uid, kind


def _is_edited(scene: Any, kind: Kind) -> bool:
    changed = IN_SCENE[kind].changed(scene, _states[_key(scene, kind)])
    return changed is not None and changed.mode == "EDIT"


def _stored_state(scene: Any, kind: Kind) -> RequestState:
    """A request that was not seen yet, as it is stored."""
    state = RequestState(kind)
    if kind in STORED:
        subject, result_shown = _read_stored(scene, kind)
        state = replace(state, subject=subject, result_shown=result_shown)
    return replace(state, folder=_locate(scene, state))


def _read_stored(scene: Any, kind: Kind) -> tuple[Path | None, bool]:
    settings, (subject, result_shown) = (
        getattr(scene, ids.SETTINGS),
        IN_SCENE[kind].stored or ("", ""),
    )
    path = getattr(settings, subject)
    return Path(path) if path else None, getattr(settings, result_shown)


def _locate(scene: Any, state: RequestState) -> Path | None:
    """The request's folder; where a run is gone, that in the scene's run folder, which may have
    moved along with the .blend file."""
    if state.kind not in STORED or state.subject is None:
        return state.folder
    named = request_folder(state.subject)
    if state.kind == Kind.TRAINING and not named.is_dir():
        beside = request_folder(Path(bpy.path.abspath(getattr(scene, ids.SETTINGS).run_folder)))
        return beside if beside.is_dir() else named
    return named


def _read_scene(scene: Any, kind: Kind) -> RequestState:
    """Compare the request's state with what is stored in the scene."""
    key = _key(scene, kind)
    if key not in _states:
        _states[key] = _stored_state(scene, kind)
    elif kind in STORED:
        return _handle(scene, kind, states.SceneRead(*_read_stored(scene, kind)))
    return _states[key]


def _read_status(
    scene: Any, state: RequestState, show_result: bool | None = None
) -> states.StatusRead:
    folder = _locate(scene, state)
    assert folder is not None
    if state.kind not in STORED:
        return states.StatusRead(folder, inspect_status(folder))
    settings, run = getattr(scene, ids.SETTINGS), replace(state, folder=folder).run
    files = RunFiles(
        _stamp(folder.parent / CAPTURE_FOLDER / SPLIT_FILES[0])
        if state.kind == Kind.AVATAR
        else None,
        _stamp(folder / PICTURE),
        *map(_stamp, (folder / PREVIEW, run / AVATAR, run / METRICS, run / TRACKING)),
    )
    shown = settings.show_result if show_result is None else show_result
    return states.StatusRead(folder, inspect_status(folder), files, settings.live_preview, shown)


def _stamp(path: Path) -> states.Stamp | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _handle(scene: Any, kind: Kind, event: states.Event) -> RequestState:
    """Feed the event to the request's state, carry out the effects, and feed their answers in turn.

    Raises StgaError where files cannot be written or removed; the state is that of before then.
    """
    key = _key(scene, kind)
    state, effects = transition(_states.get(key) or _stored_state(scene, kind), event)
    answers = [_carry_out(scene, state, effect) for effect in effects]
    _states[key] = state
    for answer in answers:
        if answer is not None:
            state = _handle(scene, kind, answer)
    return state


def _carry_out(scene: Any, state: RequestState, effect: states.Effect) -> states.Event | None:
    match effect:
        case states.Store(subject, result_shown):
            names = IN_SCENE[state.kind].stored
            assert names is not None
            for name, value in zip(names, (str(subject or ""), result_shown), strict=True):
                setattr(getattr(scene, ids.SETTINGS), name, value)
        case states.StoreAvatar(path):
            getattr(scene, ids.SETTINGS).avatar = str(path)
        case states.LoadAvatar(path):
            loader.load(scene, path)
        case states.Show():
            return _show(scene, state)
        case states.ReadCurve(run):
            _curves[run] = _read_curve(run) or _read_picture(state.folder)
        case states.StopWorker(folder):
            request_cancel(folder)
        case states.KillWorker(folder):
            _processes[folder].kill()
            _processes[folder].wait()
        case states.RemoveFiles(folder):
            _remove(state.kind, folder)
        case states.PushUndo():
            if has_timer():  # later: saving the scene's state takes as long as a slice
                bpy.app.timers.register(push_undo, first_interval=SLICE_INTERVAL_S)
        case states.Redraw():
            redraw()
    return None


def _show(scene: Any, state: RequestState) -> states.Event | None:
    try:
        return IN_SCENE[state.kind].show(scene, state)
    # RuntimeError: Blender refuses, for example on linked objects
    except (StgaError, RuntimeError) as error:
        return states.Failed(str(error).strip().removeprefix("Error: "))
    except Exception as error:
        return states.Failed(f"Unexpected {_describe(error)}")


def _remove(kind: Kind, folder: Path) -> None:
    """Raises StgaError while the worker is running, or where a file cannot be removed."""
    if kind in STORED:  # a file from elsewhere may name any folder
        remove_request(folder)
    else:
        if kind not in TRANSIENT:  # whose worker has ended, or was killed
            refuse_running_worker(folder)
        shutil.rmtree(folder, ignore_errors=True)
    _processes.pop(folder, None)
    for drawn in (folder.parent, folder.parent / RUN_FOLDER):
        _curves.pop(drawn, None)


def _read_curve(run: Path) -> Curve | None:
    try:
        return curve_image(read_metrics(run))
    except (StgaError, KeyError, TypeError, ValueError):
        return None  # training reports a damaged file


def _read_picture(folder: Path | None) -> Curve | None:
    """What the tracking of the request in this folder shows."""
    try:
        rgb = read_npz(folder / PICTURE)["rgb"] if folder is not None else None
    except (StgaError, KeyError):
        return None
    if rgb is None or rgb.ndim != 3 or rgb.dtype != np.uint8:
        return None
    return (
        np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])[::-1].astype(np.float32) / 255,
        "",
        "",
    )


def push_undo() -> None:
    """Let undo come back to what is in the file now."""
    if bpy.ops.ed.undo_push.poll():
        bpy.ops.ed.undo_push(message="Show Result")


def _restart_timer() -> None:
    """Let the timer run at once, however long it would have waited."""
    global _requests_due
    _requests_due = 0.0
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    _start_timer()


def _start_timer() -> None:
    if has_timer() and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=0.0, persistent=True)


def redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES"):
                for region in area.regions:
                    if area.type == "PREFERENCES" or region.type == "UI":
                        region.tag_redraw()


def _close_watched() -> None:
    for thing in list(_watched):
        thing.close()
    _watched.clear()


def _end_unawaited() -> None:
    """End the workers whose result only a scene that is gone was to have."""
    for (_, kind), state in list(_states.items()):
        if kind in TRANSIENT and state.folder is not None:
            for effect in transition(state, states.CancelAsked())[1]:
                _carry_out(None, state, effect)


@persistent
def _before_save(path: str) -> None:
    _rebase(bpy.data.filepath, path)


@persistent
def _after_save(path: str) -> None:
    if bpy.data.filepath != path:  # a copy was saved
        _rebase(path, bpy.data.filepath)


def _rebase(old: str, new: str) -> None:
    """Let scenes find their run and avatar from another .blend file: relative where they lie beside
    it or below, so that all can be moved together."""
    beside = Path(new).parent
    own = [scene for scene in bpy.data.scenes if scene.library is None]
    for settings in [getattr(scene, ids.SETTINGS) for scene in own]:
        for name in ("run_folder", "avatar"):
            value = getattr(settings, name)
            place = Path(bpy.path.abspath(value, start=str(Path(old).parent)))
            if not value or (value.startswith("//") and not old) or not place.exists():
                continue
            is_beside = place.is_relative_to(beside)
            moved = f"//{place.relative_to(beside).as_posix()}" if is_beside else str(place)
            if moved != value:
                setattr(settings, name, moved)


@persistent
def _after_append(_: Any) -> None:
    for scene in bpy.data.scenes:
        if scene.library is None:
            _adopt(scene)


@persistent
def _after_load(_: Any) -> None:
    loader.close()
    _close_watched()
    _end_unawaited()
    for key in [key for key in _states if key[1] != Kind.VIDEO]:
        del _states[key]  # of scenes of the file before; its videos are still rendered
    _after_append(None)
    _start_timer()


def _adopt(scene: Any) -> None:
    """Let the panel work on the one head, and the splats, of a file that was made without it, as
    `stga demo` does, or into which an avatar was appended."""
    settings = getattr(scene, ids.SETTINGS)
    heads = [thing for thing in scene.objects if is_head(thing)]
    shown = [thing for thing in scene.objects if thing.get(tags.KIND) == tags.SPLATS]
    if settings.head is None and len(heads) == 1:
        settings.head = heads[0]
        show_panel()
        if settings.splats is None and len(shown) == 1:
            settings.splats = shown[0]
            settings.avatar = settings.avatar or shown[0].get(tags.AVATAR, "")
    if not has_run(Path(bpy.path.abspath(settings.run_folder))):
        settings.run_folder = run_of(settings.avatar) or settings.run_folder


@persistent
def _after_update(scene: Any, *_: Any) -> None:
    """Let the panel work on no head, and no splats, that were deleted: its pointers keep these in
    the file."""
    settings = getattr(scene, ids.SETTINGS)
    for name in ("head", "splats"):
        thing = getattr(settings, name)
        if thing is not None and thing.name not in scene.objects and not thing.users_collection:
            setattr(settings, name, None)


def show_panel() -> None:
    """Open the sidebar at the add-on's tab, where there is a window."""
    if has_timer():
        bpy.app.timers.register(_Sidebar(), first_interval=CHECK_INTERVAL_S)


class _Sidebar:
    """Opens the sidebar at the add-on's tab, from a timer, for a few seconds at most."""

    def __init__(self) -> None:
        self._attempts = 10

    def __call__(self) -> float | None:
        self._attempts -= 1
        screens = [window.screen for window in bpy.context.window_manager.windows]
        return None if open_sidebar(ids.TAB, screens) or not self._attempts else CHECK_INTERVAL_S


HANDLERS = (
    (bpy.app.handlers.load_post, _after_load),
    (bpy.app.handlers.save_pre, _before_save),
    (bpy.app.handlers.save_post, _after_save),
    (bpy.app.handlers.depsgraph_update_post, _after_update),
    (APPENDED, _after_append),
)


def register() -> None:
    for handlers, handler in HANDLERS:
        handlers.append(handler)
    _start_timer()


def unregister() -> None:
    for handlers, handler in HANDLERS:
        handlers.remove(handler)
    for timer in (tick, push_undo):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    loader.close()
    _close_watched()
    _end_unawaited()
    for (_, kind), state in _states.items():
        if kind == Kind.VIDEO and state.folder is not None:
            with suppress(StgaError):  # its worker is running
                _remove(kind, state.folder)
    for known in (_states, _curves, _processes):
        known.clear()
