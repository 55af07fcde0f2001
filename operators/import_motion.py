"""Imports a FLAME parameter file as a rigged head without a capture."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from . import ids
from .common import FileImport, file_filter, file_path, flame_model_path, flame_property, reporting
from .import_capture import bring_in


class ImportMotion(bpy.types.Operator, FileImport):
    """Import FLAME parameters (VHAP, GaussianAvatars, plain expression and pose) as a rigged,
    animated head"""

    bl_idname = ids.IMPORT_MOTION
    bl_label = "Import FLAME Motion"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filename_ext = ".npz"
    flame: flame_property()
    filter_glob: file_filter(".npz")

    @reporting
    def execute(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "motion")
        if flame_model_path(context, self.flame) is None:
            raise StgaError(
                f"{path}: holds FLAME parameters; choose your FLAME model in the add-on's "
                "preferences"
            )
        bring_in(self, context, path, self.flame)
        return {"FINISHED"}
