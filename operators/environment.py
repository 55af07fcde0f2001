"""Operators that make, test and cancel the training environment, and the choice of the Python that trains."""

import sys
from functools import lru_cache
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
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.worker.environment import find_training_python, status_folder
from ..stga_addon.worker.launch import prepare_status_folder, start_worker
from ..stga_addon.worker.status import WorkerState, inspect_worker, request_cancel
from . import ids, monitor
from .common import file_path, package, preferences, reporting

OFFLINE = "Allow Online Access in Preferences → System → Network first"


def training_python(context: Any, given: str = "") -> str:
    """The interpreter that trains: the one given, else that of `find_training_python`.

    Raises StgaError where none of them can.
    """
    return bpy.path.abspath(given) if given else find_training_python(environment_folder(), preferred_python(context))


def has_training_python(context: Any) -> bool:
    """Whether `training_python` finds one, for panels: looked up when the environment's worker changes its state."""
    folder = environment_folder()
    return bool(_lookup(folder, preferred_python(context), monitor.snapshot(status_folder(folder)).state))


@lru_cache(maxsize=1)
def _lookup(folder: Path, preferred: str, state: WorkerState) -> str:
    try:
        return find_training_python(folder, preferred)
    except StgaError:
        return ""


def preferred_python(context: Any) -> str:
    """The Python in the preferences; "" where none is."""
    stored = preferences(context)
    return bpy.path.abspath(stored.training_python) if stored and stored.training_python else ""


def environment_folder(create: bool = False) -> Path:
    """The folder of the training environment; a checkout, which is no extension, has it among Blender's user data."""
    try:
        return Path(bpy.utils.extension_path_user(package(), path="environment", create=create))
    except ValueError:
        return Path(bpy.utils.user_resource("DATAFILES", path="stga_environment", create=create))


def _is_busy() -> bool:
    return monitor.snapshot(status_folder(environment_folder())).state.is_alive


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
        return needs_idle_environment(cls)

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
        return needs_idle_environment(cls)

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = environment_folder(create=True)
        return _run(self, folder, check_arguments(folder, training_python(context, self.python)))


class CancelEnvironment(bpy.types.Operator):
    """Stop making the training environment, and remove the incomplete one"""

    bl_idname = ids.CANCEL_ENVIRONMENT
    bl_label = "Cancel"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if _is_busy():
            return True
        cls.poll_message_set("No training environment is being made")
        return False

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = status_folder(environment_folder())
        request_cancel(folder)
        monitor.monitor_worker(folder)
        return {"FINISHED"}


def needs_idle_environment(operator: Any) -> bool:
    """Poll: whether the training environment is not being made or tested."""
    if _is_busy():
        operator.poll_message_set("The training environment is being made or tested; wait, or cancel that")
        return False
    return True


def _run(operator: Any, folder: Path, arguments: list[str]) -> set[str]:
    """Start a worker of Blender's own Python for the environment; without a window, wait for it.

    Raises StgaError with the worker's error where it failed.
    """
    status = status_folder(folder)
    prepare_status_folder(status)
    process = start_worker(status, sys.executable, arguments)
    monitor.monitor_worker(status, process)
    if bpy.app.background:
        process.wait()
        final = inspect_worker(status, process)
        if final.state.failed:
            raise StgaError(final.status.error)
        operator.report({"INFO"}, final.status.message)
    return {"FINISHED"}
