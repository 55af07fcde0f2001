"""Requests from Blender: starting a worker for one, waiting for it, or carrying it out here."""

import sys
from pathlib import Path
from subprocess import Popen
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.requests.folder import check_request, read_result, worker_arguments, write_request
from ..stga_addon.requests.results import Result
from ..stga_addon.requests.values import Request
from ..stga_addon.worker.environment import missing_packages
from ..stga_addon.worker.launch import start_worker
from ..stga_addon.worker.status import WorkerState, failure_report, inspect_worker
from .environment import training_python


def ask(folder: Path, request: Request) -> None:
    """Write the request into the folder. Raises StgaError for what is known to fail, and while a worker is there."""
    check_request(request)
    write_request(folder, request)


def start(folder: Path, request: Request, python: str) -> "Popen[bytes]":
    """Write the request into the folder and start a worker for it.

    Raises StgaError as `ask` does, and where the interpreter cannot be started.
    """
    ask(folder, request)
    return start_worker(folder, python, worker_arguments(folder))


def wait(folder: Path, process: "Popen[bytes]") -> Result | None:
    """Wait for the worker; returns its result, None where it was cancelled.

    Raises StgaError with its error where it failed; the traceback goes to the console.
    """
    process.wait()
    last = inspect_worker(folder, process)
    if last.state.failed:
        print(failure_report(folder, last), file=sys.stderr)
        raise StgaError(last.status.error)
    return None if last.state == WorkerState.CANCELLED else read_result(folder)


def wait_for_result(folder: Path, process: "Popen[bytes]") -> Result:
    """`wait` for work that leaves nothing when it is cancelled: raises StgaError then, too."""
    result = wait(folder, process)
    if result is None:
        raise StgaError("The worker was cancelled")
    return result


def waits(operator: Any) -> bool:
    """Whether an operator with `wait_property`, or any without a window, returns only when the work is done."""
    return bool(operator.wait or bpy.app.background)


def python_of(operator: Any, context: Any) -> str | None:
    """The interpreter that is to carry out a request; None: that of Blender, where it waits and has the packages.

    Raises StgaError where there is none.
    """
    if waits(operator) and not operator.python and not missing_packages():
        return None
    return training_python(context, operator.python)


def perform_here(context: Any, folder: Path) -> Result | None:
    """Carry out the request in the folder in Blender's own Python, with Blender's progress at the pointer.

    Returns None where it was cancelled. Raises what the work raises.
    """
    from ..stga_addon.perform.perform import perform_in_folder

    manager = context.window_manager

    def show(progress: Any) -> bool:
        manager.progress_update(100 * progress.share)
        return False

    manager.progress_begin(0, 100)
    try:
        return perform_in_folder(folder, also=show)
    finally:
        manager.progress_end()
