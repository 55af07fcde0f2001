"""FLAME parameter file → rigged head without a capture."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene.compat import PATH_OPTIONS
from . import ids
from .common import file_path, flame_model_path, flame_property, reporting
from .import_capture import bring_in


class ImportMotion(bpy.types.Operator):
    """Import FLAME parameters (VHAP, GaussianAvatars, plain expression and pose) as a rigged, animated head"""

    bl_idname = ids.IMPORT_MOTION
    bl_label = "Import FLAME Motion"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(
        name="File", description="FLAME parameters (.npz)", subtype="FILE_PATH", options=PATH_OPTIONS
    )
    flame: flame_property()
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})

    def invoke(self, context: Any, event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "motion")
        if flame_model_path(context, self.flame) is None:
            raise StgaError(f"{path}: holds parameters of FLAME; choose your FLAME model in the add-on's preferences")
        bring_in(self, context, path, self.flame)
        return {"FINISHED"}
