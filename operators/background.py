"""Short requests about a scene, one for each at a time, whose result is put into the scene when it is there."""

import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.requests.folder import FILES, read_result, remove_request
from ..stga_addon.requests.results import Result
from ..stga_addon.requests.values import Request
from ..stga_addon.worker.status import WorkerState, remove_status_folder
from . import ids, monitor
from .environment import training_python
from .request import start as start_request
from .request import wait_for_result


@dataclass(frozen=True)
class BackgroundRequest:
    """A request whose result changes the scene.

    show       puts the result into the scene; may raise StgaError
    error      property of the scene's settings that says why it failed, empty where it did not
    changes_head  whether `show` changes the head's mesh, which has to wait until that leaves Edit Mode
    """

    request: Request
    show: Callable[[Any, Any], None]
    error: str
    changes_head: bool = False


@dataclass(frozen=True)
class _Running:
    work: BackgroundRequest
    folder: Path
    process: "Popen[bytes]"


_running: dict[int, _Running] = {}
"""Session id of a scene -> its request that a worker carries out."""


def start(context: Any, work: BackgroundRequest) -> None:
    """Start a worker for a request about the scene; without a window, where no timer runs, wait for it.

    Raises StgaError where it was waited for and failed.
    """
    scene, python = context.scene, training_python(context)
    folder = Path(tempfile.mkdtemp(prefix="stga_"))
    try:
        process = start_request(folder, work.request, python)
    except StgaError:
        remove_status_folder(folder, FILES)
        raise
    setattr(getattr(scene, ids.SETTINGS), work.error, "")
    if not monitor.has_timer():
        try:
            work.show(scene, wait_for_result(folder, process))
        except StgaError as error:
            sentence = _without_option(str(error))
            setattr(getattr(scene, ids.SETTINGS), work.error, sentence)
            raise StgaError(sentence) from error
        finally:
            remove_request(folder)
        return
    uid = scene.session_uid
    _running[uid] = _Running(work, folder, process)
    monitor.monitor_worker(folder, process, lambda: _show_result(uid))


def running(scene: Any) -> BackgroundRequest | None:
    """The scene's request that a worker carries out."""
    worker = _running.get(scene.session_uid)
    return None if worker is None else worker.work


def is_waiting(scene: Any) -> bool:
    """Whether the result is there and is shown once the head leaves Edit Mode."""
    worker = _running.get(scene.session_uid)
    if worker is None or not worker.work.changes_head:
        return False
    head = getattr(scene, ids.SETTINGS).head
    finished = monitor.snapshot(worker.folder).state == WorkerState.FINISHED
    return finished and head is not None and head.mode == "EDIT"


def needs_idle(operator: Any, context: Any) -> bool:
    """Poll: whether no request about the scene is being carried out; says so where one is."""
    if running(context.scene) is None:
        return True
    operator.poll_message_set("Another command is running")
    return False


def cancel(scene: Any) -> None:
    """End the scene's worker; what is shown stays."""
    _drop(scene.session_uid)


def stop() -> None:
    """End every worker."""
    for uid in list(_running):
        _drop(uid)


def _drop(uid: int) -> None:
    worker = _running.pop(uid)
    monitor.forget_worker(worker.folder)
    worker.process.kill()
    worker.process.wait()
    remove_request(worker.folder)


def _show_result(uid: int) -> bool:
    """Show the result of an ended worker, or why it failed, earlier results stay then; False: it must wait."""
    worker, scene = _running.get(uid), next((each for each in bpy.data.scenes if each.session_uid == uid), None)
    if worker is None:
        return True
    if scene is not None:
        if is_waiting(scene):
            return False
        setattr(getattr(scene, ids.SETTINGS), worker.work.error, _shown(scene, worker))
    del _running[uid]
    monitor.forget_worker(worker.folder)
    remove_request(worker.folder)
    return True


def _without_option(sentence: str) -> str:
    """The sentence without the command line's option, which the panel has not."""
    return sentence.removeprefix("--effect ")


def _shown(scene: Any, worker: _Running) -> str:
    """Show the result; returns why that failed."""
    try:
        last = monitor.inspect_status(worker.folder)
        if last.state.failed:
            return _without_option(last.status.error)
        result: Result = read_result(worker.folder)
        worker.work.show(scene, result)
    except StgaError as error:
        return str(error)
    except Exception as error:  # it must not end the timer
        traceback.print_exc()
        return f"Unexpected error ({type(error).__name__}: {error}); see the console"
    return ""
