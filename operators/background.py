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
from .request import wait


@dataclass(frozen=True)
class Question:
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
class _Asked:
    question: Question
    folder: Path
    process: "Popen[bytes]"


_asked: dict[int, _Asked] = {}
"""Session id of a scene -> its question that is not answered yet."""


def start(context: Any, question: Question) -> None:
    """Start a worker for the scene's question; without a window, where no timer runs, wait for it.

    Raises StgaError where it was waited for and failed.
    """
    scene, python = context.scene, training_python(context)
    folder = Path(tempfile.mkdtemp(prefix="stga_"))
    try:
        process = start_request(folder, question.request, python)
    except StgaError:
        remove_status_folder(folder, FILES)
        raise
    setattr(getattr(scene, ids.SETTINGS), question.error, "")
    if not monitor.has_timer():
        try:
            question.show(scene, wait(folder, process))
        except StgaError as error:
            sentence = _without_option(str(error))
            setattr(getattr(scene, ids.SETTINGS), question.error, sentence)
            raise StgaError(sentence) from error
        finally:
            remove_request(folder)
        return
    uid = scene.session_uid
    _asked[uid] = _Asked(question, folder, process)
    monitor.monitor_worker(folder, process, lambda: _show_answer(uid))


def running(scene: Any) -> Question | None:
    """The scene's question that is not answered yet."""
    asked = _asked.get(scene.session_uid)
    return None if asked is None else asked.question


def is_waiting(scene: Any) -> bool:
    """Whether the answer is there and is shown once the head leaves Edit Mode."""
    asked = _asked.get(scene.session_uid)
    if asked is None or not asked.question.changes_head:
        return False
    head = getattr(scene, ids.SETTINGS).head
    finished = monitor.snapshot(asked.folder).state == WorkerState.FINISHED
    return finished and head is not None and head.mode == "EDIT"


def needs_idle(operator: Any, context: Any) -> bool:
    """Poll: whether no question of the scene is open; says so where one is."""
    if running(context.scene) is None:
        return True
    operator.poll_message_set("Another command is running")
    return False


def cancel(scene: Any) -> None:
    """Drop the scene's question; what is shown stays."""
    _drop(scene.session_uid)


def stop() -> None:
    """Drop every question."""
    for uid in list(_asked):
        _drop(uid)


def _drop(uid: int) -> None:
    asked = _asked.pop(uid)
    monitor.forget_worker(asked.folder)
    asked.process.kill()
    asked.process.wait()
    remove_request(asked.folder)


def _show_answer(uid: int) -> bool:
    """Show the answer of an ended worker, or why it failed, earlier results stay then; False: it must wait."""
    asked, scene = _asked.get(uid), next((each for each in bpy.data.scenes if each.session_uid == uid), None)
    if asked is None:
        return True
    if scene is not None:
        if is_waiting(scene):
            return False
        setattr(getattr(scene, ids.SETTINGS), asked.question.error, _shown(scene, asked))
    del _asked[uid]
    remove_request(asked.folder)
    return True


def _without_option(sentence: str) -> str:
    """The sentence without the command line's option, which the panel has not."""
    return sentence.removeprefix("--effect ")


def _shown(scene: Any, asked: _Asked) -> str:
    """Show the answer; returns why that failed."""
    try:
        last = monitor.inspect_status(asked.folder)
        if last.state.failed:
            return _without_option(last.status.error)
        result: Result = read_result(asked.folder)
        asked.question.show(scene, result)
    except StgaError as error:
        return str(error)
    except Exception as error:  # it must not end the timer
        traceback.print_exc()
        return f"Unexpected error ({type(error).__name__}: {error}); see the console"
    return ""
