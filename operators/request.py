"""Requests from Blender: starting a worker for one, or carrying it out here; cancelling, dismissing
and reporting it. The Python that tracks and trains: its choice, its test, and the kernels that it
compiles before they are asked for."""

import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from subprocess import Popen
from time import monotonic
from typing import Any

import bpy

from ..stga_addon import __version__
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs import perform, table
from ..stga_addon.jobs.monitor_state import CancelAsked, Dismissed
from ..stga_addon.jobs.python_check import CHECK_TIMEOUT_S, Checked, finish_check, start_check
from ..stga_addon.jobs.table import KINDS, Kind
from ..stga_addon.raster.kernel_cache import has_kernels
from ..stga_addon.scene.objects import show_progress
from ..stga_addon.worker import launch
from ..stga_addon.worker.launch import CACHE_VARIABLE, start_worker
from ..stga_addon.worker.status import WorkerState, failure_report
from ..stga_addon.worker.training_python import find_training_python
from . import monitor, options
from .common import Action, AtEnd, Poll, file_path, need, package, polled, preferences
from .options import ONCE

POLL_INTERVAL_S = 0.3
PREPARATION = "stga_addon.jobs.compile_ahead"
START_DELAY_S = 1.0
"""After the extension was enabled: neither enabling nor Blender's start waits for a process."""

_preparations: list["Popen[bytes]"] = []


def start(
    scene: Any,
    request: table.Request,
    python: str | None,
    folder: Path | None = None,
    wait: bool = False,
) -> bool:
    """Start a worker for a request about the scene, whose result the monitor brings into the scene.

    python: the worker's interpreter; None: Blender's own carries the request out, here and now.
    folder: of the request; None: in the run or capture, or a temporary one. wait: for the end, as
    always without a window. Returns whether it was waited for. Raises StgaError for what is known
    to fail, while a worker is there, and where the interpreter cannot be started; where it was
    waited for, also with the error of the worker or of its result.
    """
    job = table.JOBS[type(request)]
    kind = job.kind
    assert kind is not None, f"Blender asks for no {type(request).__name__}"
    subject = getattr(request, job.subject)
    if folder is None and kind in table.STORED:
        folder = perform.request_folder(subject)
    folder = folder or Path(tempfile.mkdtemp(prefix="stga_"))
    try:
        job.check(request)
        perform.write_request(folder, request)
        arguments = perform.worker_arguments(folder)
        process = None if python is None else start_worker(folder, python, arguments)
    except StgaError:
        if kind in table.TRANSIENT:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    monitor.follow(scene, kind, subject, folder, process)
    if process is None:
        perform.perform_in_folder(folder, also=_show)
    elif not wait and monitor.has_timer():
        monitor.check_now(scene, kind)
        return False
    else:
        process.wait()
    last = monitor.inspect_status(folder)
    if last.state.failed:
        print(failure_report(folder, last), file=sys.stderr)
    shown = monitor.finish(scene, kind)
    if last.state.failed or shown.error:
        raise StgaError(shown.error or last.status.error)
    if (
        last.state == WorkerState.CANCELLED and kind not in table.TRAINS
    ):  # which keep the avatar so far
        raise StgaError("The worker was cancelled")
    return True


def _show(progress: Any) -> bool:
    """Show at the pointer how far a request is that Blender's own Python carries out."""
    show_progress(progress.share)
    return False


def _states(context: Any, kinds: Iterable[Kind] = Kind) -> list[Any]:
    return [monitor.state_of(context.scene, kind) for kind in kinds]


def idle(*kinds: Kind) -> Poll:
    """Poll: whether no request of these kinds is running."""

    def poll(operator: Any, context: Any) -> bool:
        running = [each.kind for each in _states(context, kinds) if each.is_running]
        message = f"{KINDS[running[0]].label} is running; wait, or cancel it" if running else ""
        return polled(operator, not running, message)

    return poll


def _kind_property(kinds: Any) -> Any:
    items = [(kind.value, kind.value.capitalize(), KINDS[kind].label) for kind in sorted(kinds)]
    return options.choice("Request", "What was asked for", *items)


class Cancel(Action, bpy.types.Operator):
    """Stop a request that is running"""

    request: _kind_property(Kind)

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:
        return KINDS[Kind(properties.request)].cancel

    needs = (
        need(
            lambda context: any(each.is_running for each in _states(context)), "Nothing is running"
        ),
    )

    def run(self, context: Any) -> None:
        kind = Kind(self.request)
        if not monitor.state_of(context.scene, kind).is_running:
            raise StgaError(f"{KINDS[kind].label} is not running")
        monitor.handle(context.scene, kind, CancelAsked())
        monitor.check_now(context.scene, kind)


class Dismiss(Action, bpy.types.Operator):
    """Remove status and log of a request that has ended; what it made stays, such as a run with its
    checkpoints"""

    request: _kind_property(table.DISMISSIBLE)

    needs = (
        need(
            lambda context: any(each.can_be_dismissed for each in _states(context)),
            "Nothing has ended here",
        ),
    )

    def run(self, context: Any) -> None:
        kind = Kind(self.request)
        if not monitor.state_of(context.scene, kind).can_be_dismissed:
            raise StgaError(f"{KINDS[kind].label} is running, or was never asked for in this scene")
        monitor.handle(context.scene, kind, Dismissed())


class CopyReport(Action, bpy.types.Operator):
    """Copy the error message, traceback and log of a worker to the clipboard"""

    directory: options.text(
        "Folder",
        "Status folder of the worker; empty: that of the scene's training",
        subtype="DIR_PATH",
        options=ONCE,
    )

    def run(self, context: Any) -> None:
        folder = monitor.state_of(context.scene, Kind.TRAINING).folder
        if self.directory or folder is None:
            folder = file_path(self.directory, "folder")
        versions = f"STGA {__version__}, Blender {bpy.app.version_string}, {platform.platform()}"
        report = failure_report(folder, monitor.inspect_status(folder))
        context.window_manager.clipboard = f"{versions}\n{report}"
        self.inform("Copied to the clipboard")


# The Python that tracks and trains


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
    if has_kernels(launch.cache_folder() / launch.KERNELS):
        return
    if all(process.poll() is not None for process in _preparations):
        with suppress(StgaError):  # training says what is missing
            python = training_python(bpy.context)
            _preparations.append(launch.start_in_background(python, [PREPARATION]))


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
