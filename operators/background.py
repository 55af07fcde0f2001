"""Short commands in the training environment, one for each scene at a time, whose output a timer shows in the panel."""

import subprocess
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from threading import Thread
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.worker.launch import start_python
from . import ids, monitor
from .environment import training_python

CHECK_INTERVAL_S = 0.3


class _Process:
    """A worker whose output a thread reads: a full pipe would block it for ever."""

    def __init__(self, python: str, arguments: list[str]) -> None:
        self._process = start_python(
            python, arguments, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8", errors="replace",
        )  # fmt: skip
        self._output = ("", "")
        self._thread = Thread(target=self._read, name="stga command", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        self._output = self._process.communicate()

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive()

    @property
    def has_succeeded(self) -> bool:
        return not self.is_running and self._process.returncode == 0

    def output(self) -> str:
        """Wait for the worker; what it printed. Raises StgaError with its error message where it failed."""
        self._thread.join()
        output, errors = self._output
        code = self._process.returncode
        if code:
            lines = errors.strip().splitlines() or [f"The command exited unexpectedly (exit code {code})"]
            raise StgaError(lines[-1].removeprefix("stga: ").removeprefix("--effect "))
        return output

    def cancel(self) -> None:
        self._process.kill()
        self._thread.join()


@dataclass(frozen=True)
class Command:
    """A command of `python -m stga_addon`.

    arguments  of the command
    show       puts what it printed into the scene; may raise StgaError
    error      property of the scene's settings that says why it failed, empty where it did not
    changes_head  whether `show` changes the head's mesh, which has to wait until that leaves Edit Mode
    """

    arguments: list[str]
    show: Callable[[Any, str], None]
    error: str
    changes_head: bool = False


_running: dict[int, tuple[Command, _Process]] = {}
"""Session id of a scene -> its command."""


def start(context: Any, command: Command) -> None:
    """Start the command for the scene; without a window, where no timer runs, wait for it.

    Raises StgaError where it was waited for and failed.
    """
    process = _Process(training_python(context), ["stga_addon", *command.arguments])
    setattr(getattr(context.scene, ids.SETTINGS), command.error, "")
    if not monitor.has_timer():
        _show(context.scene, command, process)
        if message := getattr(getattr(context.scene, ids.SETTINGS), command.error):
            raise StgaError(message)
        return
    _running[context.scene.session_uid] = command, process
    if not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=CHECK_INTERVAL_S, persistent=True)


def running(scene: Any) -> Command | None:
    """The scene's command that has not finished yet."""
    command, _ = _running.get(scene.session_uid, (None, None))
    return command


def is_waiting(scene: Any) -> bool:
    """Whether the scene's command has succeeded and is shown once the head leaves Edit Mode."""
    if scene.session_uid not in _running:
        return False
    command, process = _running[scene.session_uid]
    head = getattr(scene, ids.SETTINGS).head
    return command.changes_head and process.has_succeeded and head is not None and head.mode == "EDIT"


def needs_idle(operator: Any, context: Any) -> bool:
    """Poll: whether no such command runs for the scene; says so where one does."""
    if running(context.scene) is None:
        return True
    operator.poll_message_set("Another command is running")
    return False


def cancel(scene: Any) -> None:
    """End the scene's command; what is shown stays."""
    _running.pop(scene.session_uid)[1].cancel()


def stop() -> None:
    """Cancel every command."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    for _, process in _running.values():
        process.cancel()
    _running.clear()


def tick() -> float | None:
    """Show what has finished; seconds until the next call, as bpy.app.timers expects."""
    if bpy.app.is_job_running("RENDER"):  # its thread reads what would be changed
        return CHECK_INTERVAL_S
    scenes = {scene.session_uid: scene for scene in bpy.data.scenes}
    for uid in [uid for uid, (_, process) in _running.items() if not process.is_running]:
        if uid in scenes and is_waiting(scenes[uid]):
            continue
        command, process = _running.pop(uid)
        if uid in scenes:
            _show(scenes[uid], command, process)
    monitor.redraw()
    return CHECK_INTERVAL_S if _running else None


def _show(scene: Any, command: Command, process: _Process) -> None:
    """Show what the command printed, or say what failed; earlier results stay then."""
    message = ""
    try:
        command.show(scene, process.output())
    except StgaError as error:
        message = str(error)
    except Exception as error:  # it must not end the timer
        traceback.print_exc()
        message = f"Unexpected error ({type(error).__name__}: {error}); see the console"
    setattr(getattr(scene, ids.SETTINGS), command.error, message)
