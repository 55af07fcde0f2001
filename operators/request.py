"""Requests from Blender: starting a worker for one, or carrying it out here; cancelling and
dismissing it."""

import shutil
import sys
import tempfile
from pathlib import Path
from subprocess import Popen
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.perform import (
    check_request,
    perform_in_folder,
    request_folder,
    worker_arguments,
    write_request,
)
from ..stga_addon.jobs.table import (
    DISMISSIBLE,
    JOBS,
    KINDS,
    STORED,
    TRAINS,
    TRANSIENT,
    Kind,
    Request,
)
from ..stga_addon.worker.launch import start_worker
from ..stga_addon.worker.status import WorkerSnapshot, WorkerState, failure_report, inspect_worker
from ..stga_addon.worker.training_python import missing_packages
from . import ids, monitor
from .common import polled, reporting
from .training_python import training_python


def start(
    scene: Any, request: Request, python: str | None, folder: Path | None = None, wait: bool = False
) -> bool:
    """Start a worker for a request about the scene, whose result the monitor brings into the scene.

    python: the worker's interpreter; None: Blender's own carries the request out, here and now.
    folder: of the request; None: in the run or capture, or a temporary one. wait: for the end, as
    always without a window. Returns whether it was waited for. Raises StgaError for what is known
    to fail, while a worker is there, and where the interpreter cannot be started; where it was
    waited for, also with the error of the worker or of its result.
    """
    job = JOBS[type(request)]
    kind, subject = job.kind, getattr(request, job.subject)
    assert kind is not None
    if folder is None:
        folder = (
            request_folder(subject) if kind in STORED else Path(tempfile.mkdtemp(prefix="stga_"))
        )
    try:
        process = _write_and_start(folder, request, python)
    except StgaError:
        if kind in TRANSIENT:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    monitor.follow(scene, kind, subject, folder, process)
    if process is None:
        _perform_here(folder)
    elif not wait and monitor.has_timer():
        monitor.check_now(scene, kind)
        return False
    else:
        process.wait()
    last = final_snapshot(folder, process)
    shown = monitor.finish(scene, kind)
    if last.state.failed or shown.error:
        raise StgaError(shown.error or last.status.error)
    if last.state == WorkerState.CANCELLED and kind not in TRAINS:  # which keep the avatar so far
        raise StgaError("The worker was cancelled")
    return True


def _write_and_start(folder: Path, request: Request, python: str | None) -> "Popen[bytes] | None":
    check_request(request)
    write_request(folder, request)
    return None if python is None else start_worker(folder, python, worker_arguments(folder))


def _perform_here(folder: Path) -> None:
    """Carry out the request in the folder in Blender's own Python, with Blender's progress at the
    pointer.

    Raises what the work raises.
    """
    manager = bpy.context.window_manager

    def show(progress: Any) -> bool:
        manager.progress_update(100 * progress.share)
        return False

    manager.progress_begin(0, 100)
    try:
        perform_in_folder(folder, also=show)
    finally:
        manager.progress_end()


def final_snapshot(folder: Path, process: "Popen[bytes] | None") -> WorkerSnapshot:
    """The status of a worker that has ended; where it failed, its report goes to the console."""
    last = inspect_worker(folder, process)
    if last.state.failed:
        print(failure_report(folder, last), file=sys.stderr)
    return last


def python_of(operator: Any, context: Any) -> str | None:
    """The interpreter that is to carry out a request; None: that of Blender, where it waits and has
    the packages.

    Raises StgaError where there is none.
    """
    if (operator.wait or bpy.app.background) and not operator.python and not missing_packages():
        return None
    return training_python(context, operator.python)


def needs_idle(operator: Any, context: Any, *kinds: Kind) -> bool:
    """Poll: whether no request of these kinds is running."""
    running = next(
        (kind for kind in kinds if monitor.state_of(context.scene, kind).is_running), None
    )
    return running is None or polled(
        operator, False, f"{KINDS[running].label} is running; wait, or cancel it"
    )


def _kind_property(kinds: Any) -> Any:
    return bpy.props.EnumProperty(
        name="Request",
        description="What was asked for",
        items=[
            (kind.value, kind.value.capitalize(), KINDS[kind].label)
            for kind in Kind
            if kind in kinds
        ],
    )


class Cancel(bpy.types.Operator):
    """Stop a request that is running"""

    bl_idname = ids.CANCEL
    bl_label = "Cancel"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    request: _kind_property(Kind)

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:
        return KINDS[Kind(properties.request)].cancel

    @classmethod
    def poll(cls, context: Any) -> bool:
        is_running = any(monitor.state_of(context.scene, kind).is_running for kind in Kind)
        return polled(cls, is_running, "Nothing is running")

    @reporting
    def execute(self, context: Any) -> set[str]:
        kind = Kind(self.request)
        if not monitor.state_of(context.scene, kind).is_running:
            raise StgaError(f"{KINDS[kind].label} is not running")
        monitor.cancel(context.scene, kind)
        return {"FINISHED"}


class Dismiss(bpy.types.Operator):
    """Remove status and log of a request that has ended; what it made stays, such as a run with its
    checkpoints"""

    bl_idname = ids.DISMISS
    bl_label = "Dismiss"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    request: _kind_property(DISMISSIBLE)

    @classmethod
    def poll(cls, context: Any) -> bool:
        has_ended = any(
            monitor.state_of(context.scene, kind).can_be_dismissed for kind in DISMISSIBLE
        )
        return polled(cls, has_ended, "Nothing has ended in this scene that could be dismissed")

    @reporting
    def execute(self, context: Any) -> set[str]:
        kind = Kind(self.request)
        if not monitor.state_of(context.scene, kind).can_be_dismissed:
            raise StgaError(f"{KINDS[kind].label} is running, or was never asked for in this scene")
        monitor.dismiss(context.scene, kind)
        return {"FINISHED"}
