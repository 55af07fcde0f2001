"""Imports a folder of tracked meshes as an animated head without a capture."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.capture.meshes import MESH_SUFFIXES
from . import ids
from .common import FileImport, file_filter, file_path, path_property, reporting
from .import_capture import bring_in


class ImportMeshes(bpy.types.Operator, FileImport):
    """Import a folder of meshes with the same triangles, one for each frame, as an animated head"""

    bl_idname = ids.IMPORT_MESHES
    bl_label = "Import Mesh Sequence"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filepath: path_property(
        "File", "Any mesh of the sequence; the whole folder is imported", options={"SKIP_SAVE"}
    )
    filter_glob: file_filter(*MESH_SUFFIXES)

    @reporting
    def execute(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "mesh sequence")
        bring_in(self, context, path if path.is_dir() else path.parent)
        return {"FINISHED"}
