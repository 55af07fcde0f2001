"""The Python that trains: made here, or one that is there already."""

import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.worker import environment as runtime
from ..stga_addon.worker import process as task
from . import ids, monitor
from .common import file_path, package, preferences, reporting


def training_python(context: Any, given: str = "") -> str:
    """The interpreter that trains: the one given, the preferences', the one made here, or Blender's own.

    Raises StgaError where none of them can.
    """
    stored = preferences(context)
    chosen = given or (stored.runtime_python if stored else "")
    if chosen:
        return bpy.path.abspath(chosen)
    made = runtime.made_python(runtime_folder())
    if made is not None:
        return str(made)
    missing = runtime.missing_here()
    if missing:
        own = f"{sys.executable}, {sys.version.split()[0]}"
        raise StgaError(
            "training needs a runtime, which the add-on's preferences make or take: "
            f"Blender's own Python ({own}) lacks {', '.join(missing)}"
        )
    return sys.executable


def has_runtime(context: Any) -> bool:
    """Whether `training_python` has an answer."""
    try:
        return bool(training_python(context))
    except StgaError:
        return False


def runtime_folder(create: bool = False) -> Path:
    """Where this add-on makes its runtime; a checkout, which is no extension, has it beside the user's scripts."""
    try:
        return Path(bpy.utils.extension_path_user(package(), path="runtime", create=create))
    except ValueError:
        return Path(bpy.utils.user_resource("DATAFILES", path="stga_runtime", create=create))


def needs_quiet(operator: Any) -> bool:
    """Poll: whether the runtime is not being made or tested."""
    if monitor.snapshot(runtime.task_folder(runtime_folder())).state.is_alive:
        operator.poll_message_set("The runtime is being made or tested; wait, or cancel that")
        return False
    return True


class MakeRuntime(bpy.types.Operator):
    """Make a Python environment with PyTorch for training, in Blender's folder for user files"""

    bl_idname = ids.MAKE_ENVIRONMENT
    bl_label = "Make Runtime"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    device: bpy.props.EnumProperty(
        name="Device",
        description="What the environment is to train on",
        items=(
            ("auto", "Automatic", "An NVIDIA GPU where its driver is found, else the CPU"),
            ("cpu", "CPU", "Smaller; trains on every machine"),
            ("cuda", "CUDA", "For NVIDIA GPUs, by the package warp-lang"),
        ),
    )
    wheels: bpy.props.StringProperty(
        name="Wheels",
        description="Folder of wheel files to install from without a network; empty: download them",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
    )
    python: bpy.props.StringProperty(
        name="Python",
        description="Python 3.11 or newer that the environment is made of; empty: Blender's own",
        subtype="FILE_PATH",
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_quiet(cls)

    def invoke(self, context: Any, event: Any) -> set[str]:
        return context.window_manager.invoke_props_dialog(
            self, width=480, title="Make Training Runtime", confirm_text="Make"
        )

    def draw(self, context: Any) -> None:
        layout = self.layout
        layout.use_property_split = True
        for name in ("device", "wheels", "python"):
            layout.prop(self, name)
        column = layout.column(align=True)
        cpu, cuda = runtime.SIZES_GB["cpu"], runtime.SIZES_GB["cuda"]
        column.label(text=f"Takes about {cpu:.1f} GB for the CPU, {cuda:.1f} GB for CUDA, in")
        column.label(text=str(runtime_folder()))
        if not self.wheels and sys.platform == "linux":
            column.label(text=f"Where pytorch.org cannot be reached: {runtime.SIZES_GB['pypi']:.1f} GB")
        if not self.wheels:
            source = "Downloads from pypi.org and pytorch.org" if sys.platform == "linux" else "Downloads from pypi.org"
            offline = not bpy.app.online_access
            column.label(text=OFFLINE if offline else source, icon="ERROR" if offline else "URL")

    @reporting
    def execute(self, context: Any) -> set[str]:
        wheels = file_path(self.wheels, "wheels") if self.wheels else None
        if wheels is None and not bpy.app.online_access:
            raise StgaError(f"{OFFLINE}, or give a folder of wheels")
        if wheels is not None and not wheels.is_dir():
            raise StgaError(f"{wheels}: is not a folder; expected one of wheel files")
        folder = runtime_folder(create=True)
        base = bpy.path.abspath(self.python) if self.python else sys.executable
        return _run(self, folder, runtime.making_arguments(folder, base, self.device, wheels))


OFFLINE = "Allow Online Access in Preferences → System → Network first"


class TestRuntime(bpy.types.Operator):
    """Start the Python that would train, and say which torch, numba and device it finds, or what it lacks"""

    bl_idname = ids.TEST_ENVIRONMENT
    bl_label = "Test"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    python: bpy.props.StringProperty(
        name="Python", description="The interpreter to test; empty: the one that would train", subtype="FILE_PATH"
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_quiet(cls)

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = runtime_folder(create=True)
        return _run(self, folder, runtime.testing_arguments(folder, training_python(context, self.python)))


class CancelRuntime(bpy.types.Operator):
    """Stop making the runtime, and remove what there is of it"""

    bl_idname = ids.CANCEL_ENVIRONMENT
    bl_label = "Cancel"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if monitor.snapshot(runtime.task_folder(runtime_folder())).state.is_alive:
            return True
        cls.poll_message_set("No runtime is being made")
        return False

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = runtime.task_folder(runtime_folder())
        task.ask_to_stop(folder)
        monitor.monitor_worker(folder)
        return {"FINISHED"}


def _run(operator: Any, folder: Path, arguments: list[str]) -> set[str]:
    """Start a worker of Blender's own Python for the runtime; without a window, wait for it.

    Raises StgaError with the worker's sentence where it failed.
    """
    here = runtime.task_folder(folder)
    task.prepare(here)
    process = task.start(here, sys.executable, arguments)
    monitor.monitor_worker(here, process)
    if bpy.app.background:
        _wait(operator, here, process)
    return {"FINISHED"}


def _wait(operator: Any, folder: Path, process: "subprocess.Popen[bytes]") -> None:
    process.wait()
    last = task.look(folder, process)
    if last.state.failed:
        raise StgaError(last.status.error)
    operator.report({"INFO"}, last.status.message)
