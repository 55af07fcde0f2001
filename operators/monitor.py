"""Looks after workers: while one lives, a timer reads what it says and brings its splats into the scene."""

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from subprocess import Popen
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..stga_addon.avatar.file import Avatar, read_avatar
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.training_job import PREVIEW, job_folder
from ..stga_addon.scene import tags
from ..stga_addon.scene.display.splat_object import (
    SplatAttributes,
    avatar_attributes,
    build_next_node_group,
    can_update,
    check_head,
    update_splats,
)
from ..stga_addon.worker.status import WorkerSnapshot, WorkerState, inspect_worker
from . import ids
from .common import is_head
from .show import show

INTERVAL_S = 0.5
SLICE_S = 0.02
"""Until what was begun goes on: Blender never stands still for long, and not at all while nothing is to be shown."""

_snapshots: dict[Path, WorkerSnapshot] = {}
_processes: dict[Path, "Popen[bytes]"] = {}
"""The workers that this Blender started; others are known by their folder alone."""
_jobs: dict[int, str] = {}
"""A scene's session id -> its job: an undo step takes the scene back to before it was started."""


def started(folder: Path, process: "Popen[bytes]") -> None:
    """Look after the worker in this task folder."""
    _processes[folder] = process
    follow(folder)


def follow(folder: Path | None = None) -> None:
    """Start the timer, which ends by itself; `folder` is looked after besides the scenes' jobs."""
    if folder is not None:
        _snapshots[folder] = inspect_worker(folder, _processes.get(folder))
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=0.0, persistent=True)


def snapshot(folder: Path) -> WorkerSnapshot:
    """The task as the timer last saw it; without a timer, as it is."""
    if bpy.app.background or folder not in _snapshots:
        _snapshots[folder] = inspect_worker(folder, _processes.get(folder))
    return _snapshots[folder]


def forget(folder: Path) -> None:
    """Look after this task no more."""
    _processes.pop(folder, None)
    _snapshots.pop(folder, None)


def run_of(scene: Any) -> Path | None:
    """The run folder of the scene's job; where it is gone, the one that moved along with the .blend file.

    None where the scene has no job.
    """
    chosen = getattr(scene, ids.SETTINGS)
    if not chosen.training_run:
        return None
    began, beside = Path(chosen.training_run), Path(bpy.path.abspath(chosen.run_folder))
    return next((run for run in (began, beside) if job_folder(run).is_dir()), began)


def snapshot_of(scene: Any) -> WorkerSnapshot:
    """The scene's job as it is; `WorkerState.NONE` where there is none, or its folder is gone."""
    run = run_of(scene)
    return WorkerSnapshot() if run is None else snapshot(job_folder(run))


def set_job(scene: Any, run: Path | None) -> None:
    """Say which run the scene's job trains; None: the job is over and done with."""
    chosen = getattr(scene, ids.SETTINGS)
    chosen.training_run, chosen.result_shown = "" if run is None else str(run), False
    _jobs[scene.session_uid] = chosen.training_run


def tick() -> float | None:
    """Read what is new; what a bpy.app.timers function answers."""
    waits = [_follow_job(scene) for scene in bpy.data.scenes if scene.library is None]
    for folder in [folder for folder, last in _snapshots.items() if last.state.is_alive]:
        waits.append(INTERVAL_S if _look(folder).state.is_alive else None)
    return min((wait for wait in waits if wait is not None), default=None)


def _look(folder: Path) -> WorkerSnapshot:
    before, now = _snapshots.get(folder), inspect_worker(folder, _processes.get(folder))
    _snapshots[folder] = now
    if now != before:
        _redraw()
    return now


def _follow_job(scene: Any) -> float | None:
    """Bring the scene up to its job; seconds until there may be more to do, None where nothing is to come."""
    chosen = getattr(scene, ids.SETTINGS)
    job = chosen.training_run or _jobs.get(scene.session_uid, "")
    if not job:
        return None
    if chosen.training_run != job:
        chosen.training_run = job
    _jobs[scene.session_uid] = job
    run = run_of(scene)
    assert run is not None
    state = _look(job_folder(run)).state
    if state.is_alive:
        wait = _show(scene, job_folder(run) / PREVIEW) if chosen.live_preview else None
        return INTERVAL_S if wait is None else wait
    if state not in (WorkerState.FINISHED, WorkerState.CANCELLED) or chosen.result_shown:
        return None
    chosen.avatar = str(run / "avatar.npz")
    wait = _show(scene, run / "avatar.npz") if chosen.show_result else None
    chosen.result_shown = wait is None
    return wait


def _show(scene: Any, path: Path) -> float | None:
    """Show the avatar file on the scene's head once a thread has read it; a slice at a time.

    Returns seconds until it should be called again; None where the file is shown, or cannot be.
    """
    chosen = getattr(scene, ids.SETTINGS)
    shown = next((thing for thing in scene.objects if thing.get(tags.RUN) == chosen.training_run), None)
    if bpy.app.is_job_running("RENDER") or (shown is not None and shown.mode == "EDIT"):
        return INTERVAL_S  # neither bears a mesh that changes meanwhile
    try:
        read = _reader.poll(path)
        if read is None:
            return INTERVAL_S
        if is_head(chosen.head) and _present(scene, shown, *read):
            return SLICE_S
    except (StgaError, RuntimeError) as error:  # RuntimeError: Blender refuses, say where the head is linked
        print(f"stga: {error}")
    _reader.take(path)
    return None


def _present(scene: Any, shown: Any, avatar: Avatar, prepared: SplatAttributes) -> bool:
    """Show the avatar in the object that already shows this job's splats, or in a new one; whether there is more to do.

    A new one comes in slices, each call does one.
    """
    chosen = getattr(scene, ids.SETTINGS)
    check_head(avatar, chosen.head)
    if shown is not None and can_update(shown, avatar):
        update_splats(shown, prepared)
        return False
    if build_next_node_group(avatar):
        return True
    if shown is not None:
        bpy.data.objects.remove(shown)
    name = f"{chosen.head.name} {Path(chosen.training_run).name}"
    shown = show(scene, avatar, chosen.head, name, prepared=prepared)
    shown[tags.RUN] = chosen.training_run
    if not bpy.app.background:
        bpy.app.timers.register(_push_undo, first_interval=SLICE_S)  # saving the scene's state takes a slice as well
    return False


def _push_undo() -> None:
    if bpy.ops.ed.undo_push.poll():
        bpy.ops.ed.undo_push(message="Show Training")


class _Reader:
    """Reads avatar files in a thread, each once for every time that it changes."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._coming: dict[Path, Future[tuple[Avatar, SplatAttributes]]] = {}
        self._stamps: dict[Path, tuple[int, int]] = {}

    def poll(self, path: Path) -> tuple[Avatar, SplatAttributes] | None:
        """What has been read and not been taken; None where there is nothing new, or not yet.

        Raises StgaError where the file cannot be read.
        """
        coming = self._coming.get(path)
        if coming is not None:
            return coming.result() if coming.done() else None
        try:
            found = path.stat()
        except OSError as error:
            if path.name == PREVIEW:
                return None
            raise StgaError(f"{path}: cannot be read ({error.strerror})") from error
        stamp = found.st_mtime_ns, found.st_size
        if self._stamps.get(path) != stamp:
            self._stamps[path] = stamp
            self._pool = self._pool or ThreadPoolExecutor(1, "stga")
            self._coming[path] = self._pool.submit(_read, path)
        return None

    def take(self, path: Path) -> None:
        """What was read is shown, or never will be: read again once the file has changed."""
        self._coming.pop(path, None)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        self.__init__()  # type: ignore[misc]


_reader = _Reader()


def _read(path: Path) -> tuple[Avatar, SplatAttributes]:
    avatar = read_avatar(path)
    return avatar, avatar_attributes(avatar)


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES"):
                for region in area.regions:
                    if area.type == "PREFERENCES" or region.type == "UI":
                        region.tag_redraw()


@persistent
def _after_load(_: Any) -> None:
    for scene in bpy.data.scenes:
        if scene.library is None:
            _adopt(scene)
    follow()


def _adopt(scene: Any) -> None:
    """Let the panel work on the one head, and the splats, of a file that was made without it, as `stga demo` does."""
    chosen = getattr(scene, ids.SETTINGS)
    heads = [thing for thing in scene.objects if is_head(thing)]
    shown = [thing for thing in scene.objects if thing.get(tags.KIND) == tags.SPLATS]
    if chosen.head is None and len(heads) == 1:
        chosen.head = heads[0]
        if chosen.splats is None and len(shown) == 1:
            chosen.splats = shown[0]


def register() -> None:
    bpy.app.handlers.load_post.append(_after_load)
    follow()


def unregister() -> None:
    bpy.app.handlers.load_post.remove(_after_load)
    for timer in (tick, _push_undo):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    _reader.close()
    for known in (_snapshots, _processes, _jobs):
        known.clear()
