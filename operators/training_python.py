"""The Python that tracks and trains: its choice, and its test."""

from functools import lru_cache
from subprocess import Popen
from time import monotonic
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.python_check import CHECK_TIMEOUT_S, Checked, finish_check, start_check
from ..stga_addon.worker.training_python import find_training_python
from . import options, timers
from .common import Action, need, preferences
from .windows import redraw

POLL_INTERVAL_S = 0.3


def training_python(context: Any, given: str = "") -> str:
    """The interpreter given, else that of `find_training_python`, which may raise StgaError."""
    return bpy.path.abspath(given) if given else find_training_python(_preferred(context))


def has_training_python(context: Any) -> bool:
    """Whether `training_python` finds one, for panels."""
    return bool(_lookup(_preferred(context)))


@lru_cache(maxsize=1)
def _lookup(preferred: str) -> str:
    try:
        return find_training_python(preferred)
    except StgaError:
        return ""


def _preferred(context: Any) -> str:
    """The Python in the preferences; "" where none is."""
    stored = preferences(context)
    return bpy.path.abspath(stored.training_python) if stored and stored.training_python else ""


class _Test:
    """The last test of an interpreter: running, or with what it found."""

    python = error = ""
    found: Checked | None = None
    process: "Popen[str] | None" = None

    def begin(self, python: str) -> None:
        """Raises StgaError where the interpreter cannot be started."""
        self.process = start_check(python)
        self._begun_s = monotonic()
        self.python = python
        self.found = None
        self.error = ""

    def end(self, timeout_s: float = 1.0) -> None:
        """Wait for what the test finds, unless it has ended."""
        if self.process is None:
            return
        try:
            self.found = finish_check(self.python, self.process, timeout_s)
        except StgaError as error:
            self.error = str(error)
        self.process = None

    def tick(self) -> float | None:
        is_running = self.process is not None and self.process.poll() is None
        if is_running and monotonic() - self._begun_s < CHECK_TIMEOUT_S:
            return POLL_INTERVAL_S
        self.end()
        redraw()
        return None

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.end()


test = _Test()


class TestPython(Action, bpy.types.Operator):
    """Start the Python that tracks and trains, and report its versions of torch and numba and its
    device, or what it lacks"""

    bl_label = "Test"
    needs = (need(lambda _: test.process is None, "A test is running"),)

    python: options.text(
        "Python", "The interpreter to test; empty: the one that trains", subtype="FILE_PATH"
    )

    def run(self, context: Any) -> None:
        test.begin(training_python(context, self.python))
        if timers.has_timer():
            timers.watch(test)
            return
        test.end(CHECK_TIMEOUT_S)
        if test.found is None:
            raise StgaError(test.error)
        self.inform(test.found.line)
