"""Operator that makes the training environment; editions that must not install packages are built without it."""

import sys
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.requests.environment_make import PYPI_SIZE_GB, SIZE_GB, make_arguments
from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.worker.own_python import own_python
from . import ids
from .common import environment_folder, file_path, path_property, reporting
from .environment import run_environment_worker
from .request import needs_idle

OFFLINE = "Allow Online Access in Preferences → System → Network first"


class MakeEnvironment(bpy.types.Operator):
    """Make a Python environment with PyTorch for training, in Blender's folder for user files"""

    bl_idname = ids.MAKE_ENVIRONMENT
    bl_label = "Make Training Environment"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    wheels: path_property(
        "Wheels", "Folder of wheel files to install from without a network; empty: download them", "DIR_PATH"
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
        for name in ("wheels", "python"):
            layout.prop(self, name)
        column = layout.column(align=True)
        column.label(text=f"Takes about {SIZE_GB:.1f} GB in")
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
        base = bpy.path.abspath(self.python) if self.python else own_python()
        return run_environment_worker(self, folder, make_arguments(folder, base, wheels))
