"""Request monitor: a timer, which reads the status of workers and brings their results into their
scenes.

What is to be done is decided by `jobs.monitor_state`; this module reads files, owns the timer and
carries out effects, those that depend on the kind of request by the tables in `results`.
"""

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from subprocess import Popen
from time import sleep
from typing import Any

import bpy
import numpy as np

from ..stga_addon.errors import StgaError
from ..stga_addon.files import read_npz
from ..stga_addon.jobs import monitor_state as states
from ..stga_addon.jobs.monitor_state import RequestState, transition
from ..stga_addon.jobs.perform import remove_request, request_folder
from ..stga_addon.jobs.table import STORED, TRANSIENT, Kind
from ..stga_addon.jobs.track import CAPTURE_FOLDER, RUN_FOLDER
from ..stga_addon.scene.objects import local_scenes
from ..stga_addon.tracking.folder import SPLIT_FILES
from ..stga_addon.training.run.folder import AVATAR, TRACKING
from ..stga_addon.training.run.metrics_log import METRICS, read_metrics
from ..stga_addon.training.run.report import curve_image
from ..stga_addon.worker import status
from ..stga_addon.worker.status import PICTURE, PREVIEW
from . import timers
from .common import AtEnd, describe
from .results import (
    CAPTURES,
    PLACES,
    SHOW,
    changed_object,
    forget_heads,
    load_avatar,
    panel_head,
    record_head,
    show_tracked,
    stop_loading,
    store_avatar,
    store_head,
)
from .windows import push_undo, redraw

Curve = tuple[np.ndarray, str, str]
"""Pixels of a run's curve, the ranges of its axes and of the detail difference; or those of a
tracking's picture."""

_states: dict[tuple[int, Kind], RequestState] = {}
"""Session id of a scene and kind -> its request."""
curves: dict[Path, Curve | None] = {}
"""Run or capture folder -> its curve as last read, or the picture of a tracking."""
_processes: dict[Path, "Popen[bytes]"] = {}
"""Folder of a request -> worker that this Blender started, whose exit code is known."""


def state_of(scene: Any, kind: Kind) -> RequestState:
    """The scene's request as the timer last saw it; as it is, without a window and so a timer."""
    if timers.has_timer():
        state = _states.get((scene.session_uid, kind))
        if state is None:
            start_timer()
        return state or RequestState(kind)
    state = _last_state(scene, kind)
    if state.folder is None:
        return state
    folder = _locate(scene, state) or state.folder
    return replace(state, folder=folder, snapshot=inspect_status(folder))


def follow(
    scene: Any, kind: Kind, subject: Path, folder: Path, process: "Popen[bytes] | None" = None
) -> None:
    """The request in the folder is that of the scene, and about the head of its panel. process: its
    worker; None: this process carries it out."""
    record_head(scene, kind, panel_head(scene, kind))
    _processes.pop(folder, None)
    if process is not None:
        _processes[folder] = process
    handle(scene, kind, states.Started(subject, folder))


def finish(scene: Any, kind: Kind) -> RequestState:
    """Bring the result of a request that was waited for into the scene, of `Train` only that which
    gets the demo's shot."""
    state = _states[scene.session_uid, kind]
    shows = kind != Kind.TRAINING or bool(scene.stga.shot_run)
    state = handle(scene, kind, replace(_read_status(scene, state), show_result=shows))
    while state.loading is not None:
        state = handle(scene, kind, states.SceneFree())
        if state.loading is not None:
            sleep(states.SLICE_INTERVAL_S)
        elif state.has_result:
            state = handle(scene, kind, replace(_read_status(scene, state), show_result=True))
    return state


def check_now(scene: Any, kind: Kind) -> None:
    """Read the status of a request at once, and again as long as something is expected."""
    state = _read_scene(scene, kind)
    if state.folder is not None:
        handle(scene, kind, _read_status(scene, state))
    start_timer()


def inspect_status(folder: Path) -> status.WorkerSnapshot:
    """Status of a worker as it is now, with its exit code where this Blender started it."""
    return status.inspect_worker(folder, _processes.get(folder))


# The timer


def tick() -> float | None:
    """Check every request; seconds until the next call, None to stop the timer, as bpy.app.timers
    expects."""
    intervals = [_check(scene, kind) for scene in local_scenes() for kind in Kind]
    return min((interval for interval in intervals if interval is not None), default=None)


def _check(scene: Any, kind: Kind) -> float | None:
    """Check one request; seconds until the next check. An unexpected error is reported once, and
    ends the monitoring of this request only."""
    try:
        state = _read_scene(scene, kind)
        if state.folder is None or state.stopped:
            return None
        if not state.building:
            state = handle(scene, kind, _read_status(scene, state))
        if state.loading is not None and not bpy.app.is_job_running("RENDER"):
            changed = changed_object(scene, state)
            # Blender crashes where a mesh changes while it renders, or in Edit Mode.
            if changed is None or changed.mode != "EDIT":
                state = handle(scene, kind, states.SceneFree())
        return state.interval_s
    except Exception as error:
        sentence = f"Monitoring stopped after an unexpected {describe(error)}"
        handle(scene, kind, states.Failed(sentence, stops=True))
        return None


def start_timer() -> None:
    if timers.has_timer() and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=0.0, persistent=True)


# What is read


def _last_state(scene: Any, kind: Kind) -> RequestState:
    """A request as it was last seen, at first as it is stored."""
    state = _states.get((scene.session_uid, kind))
    if state is None:
        state = RequestState(kind)
        if kind in STORED:
            stored = _read_stored(scene, kind)
            state = replace(state, subject=stored.subject, result_shown=stored.result_shown)
        state = replace(state, folder=_locate(scene, state))
    return state


def _read_stored(scene: Any, kind: Kind) -> states.SceneRead:
    path, result_shown = (getattr(scene.stga, name) for name in PLACES[kind])
    return states.SceneRead(Path(path) if path else None, result_shown)


def _read_scene(scene: Any, kind: Kind) -> RequestState:
    """Compare the request's state with what is stored in the scene."""
    stored = kind in STORED
    return handle(scene, kind, _read_stored(scene, kind)) if stored else _last_state(scene, kind)


def _locate(scene: Any, state: RequestState) -> Path | None:
    """The request's folder; where a run is gone, that beside or in the scene's run folder, which
    may have moved along with the .blend file."""
    if state.kind not in STORED or state.subject is None:
        return state.folder
    named = request_folder(state.subject)
    if state.kind != Kind.TRAINING or named.is_dir():
        return named
    run = Path(bpy.path.abspath(scene.stga.run_folder))
    moved = run.parent / state.subject.name, run  # that of a continued run is still its parent's
    return next((request_folder(each) for each in moved if request_folder(each).is_dir()), named)


def _read_status(scene: Any, state: RequestState) -> states.StatusRead:
    folder = _locate(scene, state) or state.folder_path
    settings = scene.stga
    snapshot = inspect_status(folder)
    if state.kind not in STORED:
        return states.StatusRead(folder, snapshot)
    run = replace(state, folder=folder).run
    tracked = folder.parent / CAPTURE_FOLDER / SPLIT_FILES[0]
    capture = _stamp(tracked) if state.kind == Kind.AVATAR else None
    made = (folder / PICTURE, folder / PREVIEW, run / AVATAR, run / METRICS, run / TRACKING)
    files = states.RunFiles(capture, *map(_stamp, made))
    return states.StatusRead(folder, snapshot, files, settings.live_preview, settings.show_result)


def _stamp(path: Path) -> states.Stamp | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _read_picture(folder: Path | None) -> dict[str, np.ndarray]:
    """The arrays of what the tracking of the request in the folder shows; none where there is
    nothing yet."""
    with suppress(StgaError):
        if folder is not None:
            return read_npz(folder / PICTURE)
    return {}


def _read_curve(run: Path, picture: Mapping[str, np.ndarray]) -> Curve | None:
    """What training, or the picture of a tracking, shows; None where that is damaged, which
    training reports."""
    with suppress(StgaError, KeyError, TypeError, ValueError):
        found = curve_image(read_metrics(run))
        if found is not None:
            return found
    rgb = picture.get("rgb", np.empty(0))
    if rgb.ndim == 3 and rgb.dtype == np.uint8:
        rgba = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
        return rgba[::-1].astype(np.float32) / 255, "", ""
    return None


# Effects


def handle(scene: Any, kind: Kind, event: states.Event) -> RequestState:
    """Feed the event to the request's state, carry out the effects, and feed their answers in turn.

    Raises StgaError where files cannot be written or removed, or a worker is still at work in those
    to remove; the state is that of before then.
    """
    state, effects = transition(_last_state(scene, kind), event)
    answers = [_carry_out(scene, state, effect) for effect in effects]
    _states[scene.session_uid, kind] = state
    for answer in answers:
        if answer is not None:
            state = handle(scene, kind, answer)
    return state


def _carry_out(scene: Any, state: RequestState, effect: states.Effect) -> states.Event | None:
    match effect:
        case states.Store(subject, result_shown):
            path, flag = PLACES[state.kind]
            setattr(scene.stga, path, str(subject or ""))
            setattr(scene.stga, flag, result_shown)
            if subject is None:
                record_head(scene, state.kind, None)
            store_head(scene, state.kind)
        case states.StoreAvatar(path):
            store_avatar(scene, state, path)
        case states.LoadAvatar(path):
            load_avatar(scene, path)
        case states.Show():
            try:
                return SHOW[state.kind](scene, state)
            # RuntimeError: Blender refuses, for example on linked objects
            except (StgaError, RuntimeError) as error:
                return states.Failed(str(error).strip().removeprefix("Error: "))
            except Exception as error:
                return states.Failed(f"Unexpected {describe(error)}")
        case states.ReadCurve(run):
            picture = _read_picture(state.folder)
            curves[run] = _read_curve(run, picture)
            if state.kind in CAPTURES and state.folder is not None:
                show_tracked(scene, CAPTURES[state.kind](state), picture)
        case states.StopWorker(folder):
            status.request_cancel(folder)
        case states.KillWorker(folder):
            _processes[folder].kill()
            _processes[folder].wait()
        case states.RemoveFiles(folder):
            _remove(state.kind, folder)
        case states.PushUndo():
            if timers.has_timer():  # later: saving the scene's state takes as long as a slice
                bpy.app.timers.register(push_undo, first_interval=states.SLICE_INTERVAL_S)
        case states.Redraw():
            redraw()
    return None


def _remove(kind: Kind, folder: Path) -> None:
    """Raises StgaError while the worker is running, or where a file cannot be removed."""
    if kind in STORED:  # a file from elsewhere may name any folder
        remove_request(folder)
    else:
        if kind not in TRANSIENT:  # whose worker has ended, or was killed
            status.refuse_running_worker(folder)
        shutil.rmtree(folder, ignore_errors=True)
    _processes.pop(folder, None)
    for drawn in (folder.parent, folder.parent / RUN_FOLDER):
        curves.pop(drawn, None)


# The open file


def _close() -> None:
    """Stop what belongs to the open file, and workers whose result only its scenes were to have."""
    stop_loading()
    timers.close_watched()
    for (_, kind), state in list(_states.items()):
        if kind in TRANSIENT and state.folder is not None:
            for effect in transition(state, states.CancelAsked())[1]:
                _carry_out(None, state, effect)


def forget_file() -> None:
    """Stop what belongs to the file before, and forget its scenes; its videos are still
    rendered."""
    _close()
    forget_heads()
    for key in [key for key in _states if key[1] != Kind.VIDEO]:
        del _states[key]


def register(at_end: AtEnd) -> None:
    at_end(_end)
    start_timer()


def _end() -> None:
    for timer in (tick, push_undo):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    _close()
    for (_, kind), state in _states.items():
        if kind == Kind.VIDEO and state.folder is not None:
            with suppress(StgaError):  # its worker is running
                _remove(kind, state.folder)
    for known in (_states, curves, _processes):
        known.clear()
    forget_heads()
