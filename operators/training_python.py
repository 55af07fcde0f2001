"""The Python that tracks and trains: its choice, its test, and the kernels that it compiles before
they are asked for."""

import os
from contextlib import suppress
from functools import lru_cache
from subprocess import Popen
from time import monotonic
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.python_check import CHECK_TIMEOUT_S, Checked, finish_check, start_check
from ..stga_addon.raster.kernel_cache import has_kernels
from ..stga_addon.worker.launch import CACHE_VARIABLE, KERNELS, cache_folder, start_in_background
from ..stga_addon.worker.training_python import find_training_python
from . import monitor, options
from .common import Action, AtEnd, need, package, preferences

POLL_INTERVAL_S = 0.3
PREPARATION = "stga_addon.jobs.perform"
START_DELAY_S = 1.0
"""After the extension was enabled: neither enabling nor Blender's start waits for a process."""

_preparations: list["Popen[bytes]"] = []


def training_python(context: Any, given: str = "") -> str:
    """The interpreter that tracks and trains: the one given, else that of `find_training_python`.

    Raises StgaError where none of them can.
    """
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
    process: "Popen[bytes] | None" = None

    def begin(self, python: str) -> None:
        """Raises StgaError where the interpreter cannot be started."""
        self.process, self._begun_s = start_check(python), monotonic()
        self.python, self.found, self.error = python, None, ""

    def end(self, timeout_s: float = 1.0) -> None:
        """Wait for what the test finds."""
        try:
            self.found = finish_check(self.python, self.process, timeout_s)
        except StgaError as error:
            self.error = str(error)
        self.process = None

    def tick(self) -> float | None:
        if self.process.poll() is None and monotonic() - self._begun_s < CHECK_TIMEOUT_S:
            return POLL_INTERVAL_S
        self.end()
        monitor.redraw()
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
        if monitor.has_timer():
            monitor.watch(test)
            return
        test.end(CHECK_TIMEOUT_S)
        if test.found is None:
            raise StgaError(test.error)
        self.inform(test.found.line)


# Kernels


def begin_preparing() -> None:
    """Compile in the background what the first training would wait for; nothing without a window,
    without a Python that trains, or where it is compiled or is being compiled."""
    if bpy.app.background or CACHE_VARIABLE not in os.environ:
        return
    if has_kernels(cache_folder() / KERNELS):
        return
    if all(process.poll() is not None for process in _preparations):
        with suppress(StgaError):  # training says what is missing
            python = training_python(bpy.context)
            _preparations.append(start_in_background(python, [PREPARATION]))


def register(at_end: AtEnd) -> None:
    with suppress(ValueError):  # a checkout, which is no extension
        cache = bpy.utils.extension_path_user(package(), path="cache")
        if os.environ.setdefault(CACHE_VARIABLE, cache) == cache:
            at_end(os.environ.pop, CACHE_VARIABLE, None)
    at_end(_end_preparing)
    if not bpy.app.background:
        bpy.app.timers.register(begin_preparing, first_interval=START_DELAY_S)


def _end_preparing() -> None:
    """End what is compiling, which would write into a folder that is being removed."""
    if bpy.app.timers.is_registered(begin_preparing):
        bpy.app.timers.unregister(begin_preparing)
    for process in _preparations:
        process.kill()
        process.wait()
    _preparations.clear()
