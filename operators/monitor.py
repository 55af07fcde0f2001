"""Training monitor: a timer that reads the status of workers and shows their splats in the scene.

What is to be done is decided by `requests.monitor_state`; this module reads files, carries out effects and owns the
timer.
"""

import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from subprocess import Popen
from typing import Any

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..stga_addon.avatar.file import Avatar, read_avatar
from ..stga_addon.errors import StgaError
from ..stga_addon.report.curve_image import curve_image
from ..stga_addon.requests import monitor_state as states
from ..stga_addon.requests.folder import PREVIEW, request_folder
from ..stga_addon.requests.monitor_state import CHECK_INTERVAL_S, SLICE_INTERVAL_S, MonitorState, RunFiles, transition
from ..stga_addon.scene import tags
from ..stga_addon.scene.display.splat_attributes import SplatAttributes, avatar_attributes
from ..stga_addon.scene.display.splat_object import build_next_node_group, can_update, check_head, update_splats
from ..stga_addon.scene.viewports import open_sidebar
from ..stga_addon.training.effects.decisions import TRACKING
from ..stga_addon.training.run.metrics_log import METRICS, read_metrics
from ..stga_addon.worker.status import WorkerSnapshot, inspect_worker
from . import ids
from .common import is_head
from .show import show

Curve = tuple[np.ndarray, str, str]
"""Pixels of a run's curve, the ranges of its axes and of the detail difference."""

_states: dict[int, MonitorState] = {}
"""Session id of a scene -> its training."""
_curves: dict[Path, Curve | None] = {}
"""Run folder -> its curve as last read."""
_snapshots: dict[Path, WorkerSnapshot] = {}
"""Status folders of workers that belong to no scene: those of the training environment."""
_followers: dict[Path, Callable[[], bool]] = {}
"""Status folder -> called when its worker has ended, again until it returns True."""
_processes: dict[Path, "Popen[bytes]"] = {}
"""Status folder -> worker that this Blender started, whose exit code is known."""


def training_of(scene: Any) -> MonitorState:
    """The scene's training as the timer last saw it; without a window, where no timer runs, as it is."""
    state = _states.get(scene.session_uid)
    if has_timer():
        if state is None:
            _start_timer()
        return state or MonitorState()
    if state is None:
        run, result_shown = _stored(scene)
        state = MonitorState(run, run, result_shown=result_shown)
    if state.run is None:
        return state
    folder = _locate(scene, state.run)
    return replace(state, folder=folder, snapshot=inspect_status(request_folder(folder)))


def curve(folder: Path) -> Curve | None:
    """The curve of the run in this folder as the timer last read it; None before two evaluations."""
    return _curves.get(folder)


def start_training(scene: Any, run: Path, process: "Popen[bytes] | None") -> None:
    """Monitor a run that was started for the scene; process: its worker, None where this process trains."""
    if process is not None:
        _processes[request_folder(run)] = process
    _handle(scene, states.Started(run))
    check_now(scene)


def finish_training(scene: Any) -> None:
    """Store the result of a training that was waited for, without showing it."""
    _handle(scene, _read_status(scene, show_result=False))


def dismiss_training(scene: Any) -> None:
    """Forget the scene's training."""
    state = training_of(scene)
    if state.folder is not None:
        _processes.pop(request_folder(state.folder), None)
        _curves.pop(state.folder, None)
    _handle(scene, states.Dismissed())


def check_now(scene: Any) -> None:
    """Read the status of the scene's training at once, and again as long as something is expected."""
    if _read_scene(scene).run is not None:
        _handle(scene, _read_status(scene))
    _start_timer()


def monitor_worker(
    folder: Path, process: "Popen[bytes] | None" = None, when_ended: Callable[[], bool] | None = None
) -> None:
    """Monitor a worker until it ends; then call `when_ended`, again until it returns True, unless Blender renders."""
    if process is not None:
        _processes[folder] = process
    if when_ended is not None:
        _followers[folder] = when_ended
    _snapshots[folder] = inspect_status(folder)
    _start_timer()


def forget_worker(folder: Path) -> None:
    """No longer monitor a worker."""
    for known in (_snapshots, _followers, _processes):
        known.pop(folder, None)


def snapshot(folder: Path) -> WorkerSnapshot:
    """Status of a worker that belongs to no scene, as the timer last saw it; without a window, as it is."""
    if folder not in _snapshots or not has_timer():
        _snapshots[folder] = inspect_status(folder)
    return _snapshots[folder]


def inspect_status(folder: Path) -> WorkerSnapshot:
    """Status of a worker as it is now, with its exit code where this Blender started it."""
    return inspect_worker(folder, _processes.get(folder))


def has_timer() -> bool:
    """Whether Blender has a window, and so runs timers."""
    return not bpy.app.background


def tick() -> float | None:
    """Check every scene and worker; seconds until the next call, None to stop the timer, as bpy.app.timers expects."""
    intervals = [_check_safely(scene) for scene in bpy.data.scenes if scene.library is None]
    for folder in [folder for folder, last in _snapshots.items() if last.state.is_alive or folder in _followers]:
        intervals.append(_check_worker_safely(folder))
    return min((interval for interval in intervals if interval is not None), default=None)


def _check_safely(scene: Any) -> float | None:
    """Check one scene; an unexpected error is reported once, and ends the monitoring of this scene only."""
    try:
        return _check(scene)
    except Exception as error:
        traceback.print_exc()
        sentence = f"Monitoring stopped after an unexpected error ({type(error).__name__}: {error}); see the console"
        _handle(scene, states.MonitorFailed(sentence))
        return None


def _check_worker_safely(folder: Path) -> float | None:
    """Check a worker that belongs to no scene; after an unexpected error, which is printed, it counts as ended."""
    before = _snapshots.get(folder)
    try:
        _snapshots[folder] = inspect_status(folder)
    except Exception:
        traceback.print_exc()
        _snapshots[folder] = WorkerSnapshot()
    if _snapshots[folder] != before:
        redraw()
    if _snapshots[folder].state.is_alive:
        return CHECK_INTERVAL_S
    _call_follower(folder)
    return CHECK_INTERVAL_S if folder in _followers else None


def _call_follower(folder: Path) -> None:
    """Call what waits for the end of the worker, unless Blender renders: its thread reads what would be changed."""
    if folder not in _followers or bpy.app.is_job_running("RENDER"):
        return
    try:
        if not _followers[folder]():
            return
    except Exception:
        traceback.print_exc()
    _followers.pop(folder, None)
    redraw()


def _read_scene(scene: Any) -> MonitorState:
    """Compare the scene's state with what is stored in the scene."""
    run, result_shown = _stored(scene)
    is_new = scene.session_uid not in _states
    return _handle(scene, states.FileLoaded(run, result_shown) if is_new else states.SceneRead(run, result_shown))


def _check(scene: Any) -> float | None:
    state = _read_scene(scene)
    if state.run is None or state.stopped:
        return None
    if not state.building:
        state = _handle(scene, _read_status(scene))
    if state.loading is not None:
        state = _show_loaded(scene)
    return state.interval_s


def _stored(scene: Any) -> tuple[Path | None, bool]:
    """What the scene stores of its training: the run, and whether its result was shown."""
    settings = getattr(scene, ids.SETTINGS)
    return Path(settings.training_run) if settings.training_run else None, settings.result_shown


def _locate(scene: Any, run: Path) -> Path:
    """The run's folder; where it is gone, the scene's run folder, which may have moved along with the .blend file."""
    beside = Path(bpy.path.abspath(getattr(scene, ids.SETTINGS).run_folder))
    return next((folder for folder in (run, beside) if request_folder(folder).is_dir()), run)


def _read_status(scene: Any, show_result: bool | None = None) -> states.StatusRead:
    settings, run = getattr(scene, ids.SETTINGS), _states[scene.session_uid].run
    assert run is not None
    folder = _locate(scene, run)
    files = RunFiles(_stamp(request_folder(folder) / PREVIEW), _stamp(folder / METRICS), _stamp(folder / TRACKING))
    shown = settings.show_result if show_result is None else show_result
    return states.StatusRead(folder, inspect_status(request_folder(folder)), files, settings.live_preview, shown)


def _stamp(path: Path) -> states.Stamp | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _handle(scene: Any, event: states.Event) -> MonitorState:
    """Feed the event to the scene's state and carry out the effects."""
    state, effects = transition(_states.get(scene.session_uid, MonitorState()), event)
    _states[scene.session_uid] = state
    _carry_out(scene, effects)
    return state


def _carry_out(scene: Any, effects: Iterable[states.Effect]) -> None:
    settings = getattr(scene, ids.SETTINGS)
    for effect in effects:
        match effect:
            case states.StoreTraining(run, result_shown):
                settings.training_run, settings.result_shown = "" if run is None else str(run), result_shown
            case states.StoreAvatar(path):
                settings.avatar = str(path)
            case states.LoadAvatar(path):
                _loader.load(scene, path)
            case states.ReadCurve(folder):
                _curves[folder] = _read_curve(folder)
            case states.PushUndo():
                if has_timer():  # later: saving the scene's state takes as long as a slice
                    bpy.app.timers.register(_push_undo, first_interval=SLICE_INTERVAL_S)
            case states.Redraw():
                redraw()


def _read_curve(folder: Path) -> Curve | None:
    try:
        return curve_image(read_metrics(folder))
    except (StgaError, KeyError, TypeError, ValueError):
        return None  # training reports a damaged file


def _show_loaded(scene: Any) -> MonitorState:
    """Show the avatar that was loaded for the scene, in the object that shows this run or in a new one."""
    settings, run = getattr(scene, ids.SETTINGS), _states[scene.session_uid].run
    shown = next((thing for thing in scene.objects if thing.get(tags.RUN) == str(run)), None)
    if bpy.app.is_job_running("RENDER") or (shown is not None and shown.mode == "EDIT"):
        return _states[scene.session_uid]  # Blender crashes where a mesh changes during these
    try:
        loaded = _loader.result(scene)
        if loaded is None:
            return _states[scene.session_uid]
        if not is_head(settings.head):
            raise StgaError("No head in the scene to show the avatar on; import the capture")
        event = _present(scene, shown, *loaded)
    except (StgaError, RuntimeError) as error:  # RuntimeError: Blender refuses, for example on linked objects
        event = states.AvatarFailed(str(error))
    if not isinstance(event, states.SliceBuilt):
        _loader.discard(scene)
    return _handle(scene, event)


def _present(scene: Any, shown: Any, avatar: Avatar, attributes: SplatAttributes) -> states.Event:
    """Show the avatar, or build the next slice of what its object needs."""
    settings, run = getattr(scene, ids.SETTINGS), _states[scene.session_uid].run
    check_head(avatar, settings.head)
    if shown is not None and can_update(shown, avatar):
        update_splats(shown, attributes)
        return states.AvatarShown(created=False)
    if build_next_node_group(avatar):
        return states.SliceBuilt()
    if shown is not None:
        bpy.data.objects.remove(shown)
    assert run is not None
    shown = show(scene, avatar, settings.head, f"{settings.head.name} {run.name}", attributes=attributes)
    shown[tags.RUN] = str(run)
    return states.AvatarShown(created=True)


def _push_undo() -> None:
    if bpy.ops.ed.undo_push.poll():
        bpy.ops.ed.undo_push(message="Show Training")


class _Loader:
    """Reads avatar files in a thread, one for each scene."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._loading: dict[int, Future[tuple[Avatar, SplatAttributes]]] = {}

    def load(self, scene: Any, path: Path) -> None:
        self._pool = self._pool or ThreadPoolExecutor(1, "stga")
        self._loading[scene.session_uid] = self._pool.submit(_load, path)

    def result(self, scene: Any) -> tuple[Avatar, SplatAttributes] | None:
        """The file's content; None while it is being read. Raises StgaError where it cannot be read."""
        future = self._loading[scene.session_uid]
        return future.result() if future.done() else None

    def discard(self, scene: Any) -> None:
        self._loading.pop(scene.session_uid, None)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
        self._pool, self._loading = None, {}


_loader = _Loader()


def _load(path: Path) -> tuple[Avatar, SplatAttributes]:
    avatar = read_avatar(path)
    return avatar, avatar_attributes(avatar)


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


@persistent
def _after_load(_: Any) -> None:
    _loader.close()
    _states.clear()  # of scenes of the file before
    for scene in bpy.data.scenes:
        if scene.library is None:
            _adopt(scene)
    _start_timer()


def _adopt(scene: Any) -> None:
    """Let the panel work on the one head, and the splats, of a file that was made without it, as `stga demo` does."""
    settings = getattr(scene, ids.SETTINGS)
    heads = [thing for thing in scene.objects if is_head(thing)]
    shown = [thing for thing in scene.objects if thing.get(tags.KIND) == tags.SPLATS]
    if settings.head is None and len(heads) == 1:
        settings.head = heads[0]
        if has_timer():
            bpy.app.timers.register(_Sidebar(), first_interval=CHECK_INTERVAL_S)
        if settings.splats is None and len(shown) == 1:
            settings.splats = shown[0]
            settings.avatar = settings.avatar or shown[0].get(tags.AVATAR, "")


class _Sidebar:
    """Opens the sidebar at the add-on's tab, from a timer, for a few seconds at most."""

    def __init__(self) -> None:
        self._attempts = 10

    def __call__(self) -> float | None:
        self._attempts -= 1
        screens = [window.screen for window in bpy.context.window_manager.windows]
        return None if open_sidebar(ids.TAB, screens) or not self._attempts else CHECK_INTERVAL_S


def register() -> None:
    bpy.app.handlers.load_post.append(_after_load)
    _start_timer()


def unregister() -> None:
    bpy.app.handlers.load_post.remove(_after_load)
    for timer in (tick, _push_undo):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    _loader.close()
    for known in (_states, _curves, _snapshots, _followers, _processes):
        known.clear()
