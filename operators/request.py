"""Requests from Blender: starting a worker for one, or carrying it out here; cancelling, dismissing
and reporting it."""

import platform
import shutil
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon import __version__
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs import perform, table
from ..stga_addon.jobs.monitor_state import CancelAsked, Dismissed
from ..stga_addon.jobs.table import KINDS, Kind
from ..stga_addon.scene.objects import show_progress
from ..stga_addon.worker.launch import start_worker
from ..stga_addon.worker.status import WorkerState, failure_report
from . import monitor, options, timers
from .common import Action, Poll, file_path, need, polled
from .options import ONCE
from .results import look_for_run


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
    elif not wait and timers.has_timer():
        monitor.check_now(scene, kind)
        return False
    else:
        process.wait()
    last = monitor.inspect_status(folder)
    if last.state.failed:
        print(failure_report(folder, last), file=sys.stderr)
    finished = monitor.finish(scene, kind)
    if last.state.failed or finished.error:
        raise StgaError(finished.error or last.status.error)
    if (
        last.state == WorkerState.CANCELLED and kind not in table.TRAINS
    ):  # which keep the avatar so far
        raise StgaError("The worker was cancelled")
    return True


def _show(progress: Any) -> bool:
    """Show at the pointer how far a request is that Blender's own Python carries out."""
    show_progress(progress.fraction)
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
        look_for_run(context.scene.stga)  # which the request was known to be in


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
