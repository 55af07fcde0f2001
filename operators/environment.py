"""Operators that make and test the training environment."""

import sys
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.requests.environment_job import (
    PYPI_SIZE_GB,
    SIZE_GB,
    TRACKING_GB,
    check_arguments,
    make_arguments,
)
from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.worker.environment import status_folder
from ..stga_addon.worker.launch import prepare_status_folder, start_worker
from . import ids, monitor
from .common import environment_folder, file_path, reporting
from .request import final_snapshot, needs_idle
from .training_python import training_python

OFFLINE = "Allow Online Access in Preferences → System → Network first"


class MakeEnvironment(bpy.types.Operator):
    """Make a Python environment with PyTorch for training, in Blender's folder for user files"""

    bl_idname = ids.MAKE_ENVIRONMENT
    bl_label = "Make Training Environment"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    wheels: bpy.props.StringProperty(
        name="Wheels",
        description="Folder of wheel files to install from without a network; empty: download them",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
    )
    tracking: bpy.props.BoolProperty(
        name="Tracking",
        description="With the landmark detector that tracks heads in footage: MediaPipe. Python 3.11 or 3.12 brings "
        "its network; newer ones need Google's face_landmarker.task",
    )
    python: bpy.props.StringProperty(
        name="Python",
        description="Python 3.11 or newer to make the environment from; empty: Blender's own",
        subtype="FILE_PATH",
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.ENVIRONMENT)

    def invoke(self, context: Any, event: Any) -> set[str]:
        return context.window_manager.invoke_props_dialog(
            self, width=480, title="Make Training Environment", confirm_text="Make"
        )

    def draw(self, context: Any) -> None:
        layout = self.layout
        layout.use_property_split = True
        for name in ("tracking", "wheels", "python"):
            layout.prop(self, name)
        column = layout.column(align=True)
        column.label(text=f"Takes about {SIZE_GB + self.tracking * TRACKING_GB:.1f} GB in")
        column.label(text=str(environment_folder()))
        if not self.wheels and sys.platform == "linux":
            column.label(text=f"Where pytorch.org cannot be reached: {PYPI_SIZE_GB:.1f} GB")
        if not self.wheels:
            source = "Downloads from PyPI and pytorch.org" if sys.platform == "linux" else "Downloads from PyPI"
            offline = not bpy.app.online_access
            column.label(text=OFFLINE if offline else source, icon="ERROR" if offline else "URL")

    @reporting
    def execute(self, context: Any) -> set[str]:
        wheels = file_path(self.wheels, "wheels") if self.wheels else None
        if wheels is None and not bpy.app.online_access:
            raise StgaError(f"{OFFLINE}, or give a folder of wheels")
        if wheels is not None and not wheels.is_dir():
            raise StgaError(f"{wheels}: is not a folder; expected one of wheel files")
        folder = environment_folder(create=True)
        base = bpy.path.abspath(self.python) if self.python else sys.executable
        return _run(self, folder, make_arguments(folder, base, wheels, self.tracking))


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
        return _run(self, folder, check_arguments(folder, training_python(context, self.python)))


def _run(operator: Any, folder: Path, arguments: list[str]) -> set[str]:
    """Start a worker of Blender's own Python for the environment; without a window, wait for it.

    Raises StgaError with the worker's error where it failed.
    """
    status = status_folder(folder)
    prepare_status_folder(status)
    process = start_worker(status, sys.executable, arguments)
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
