"""Operator that tests the training environment."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.requests.environment_job import check_arguments
from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.worker.environment import status_folder
from ..stga_addon.worker.launch import prepare_status_folder, start_worker
from ..stga_addon.worker.own_python import own_python
from . import ids, monitor
from .common import environment_folder, reporting
from .request import final_snapshot, needs_idle
from .training_python import training_python


class TestEnvironment(bpy.types.Operator):
    """Start the Python that trains, and report its versions of torch and numba and its device, or what it lacks"""

    bl_idname = ids.TEST_ENVIRONMENT
    bl_label = "Test"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    python: bpy.props.StringProperty(
        name="Python", description="The interpreter to test; empty: the one that trains", subtype="FILE_PATH"
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.ENVIRONMENT)

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = environment_folder(create=True)
        return run_environment_worker(self, folder, check_arguments(folder, training_python(context, self.python)))


def run_environment_worker(operator: Any, folder: Path, arguments: list[str]) -> set[str]:
    """Start a worker of Blender's own Python for the environment; without a window, wait for it.

    Raises StgaError with the worker's error where it failed.
    """
    status = status_folder(folder)
    prepare_status_folder(status)
    process = start_worker(status, own_python(), arguments)
    monitor.follow(None, Kind.ENVIRONMENT, folder, status, process)
    if monitor.has_timer():
        monitor.check_now(None, Kind.ENVIRONMENT)
        return {"FINISHED"}
    process.wait()
    final = final_snapshot(status, process)
    if final.state.failed:
        raise StgaError(final.status.error)
    operator.report({"INFO"}, final.status.message)
    return {"FINISHED"}
