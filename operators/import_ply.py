"""Imports a world-space 3D Gaussian Splatting PLY."""

from math import radians
from typing import Any, ClassVar

import bpy

from ..stga_addon.export.ply import read_ply
from ..stga_addon.scene.display.splat_object import show_world_splats
from . import ids
from .common import FileImport, file_filter, file_path, reporting, scene_settings

# Up axis of the file -> rotation about x in degrees that turns it to Blender's.
_ROTATION_DEG = {"Y": 90.0, "-Y": -90.0, "Z": 0.0}


class ImportPly(bpy.types.Operator, FileImport):
    """Import a 3D Gaussian Splatting PLY file"""

    bl_idname = ids.IMPORT_PLY
    bl_label = "Import Gaussian Splats"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filename_ext = ".ply"
    filter_glob: file_filter(".ply")
    up: bpy.props.EnumProperty(
        name="Up", description="Axis of the file that points up",
        items=(
            ("Y", "Y", "Captures tracked with FLAME, and what this add-on exports"),
            ("-Y", "-Y", "Scenes reconstructed with COLMAP"),
            ("Z", "Z", "Blender's up axis"),
        ),
    )  # fmt: skip

    @reporting
    def execute(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "PLY")
        splats = read_ply(path)
        shown = show_world_splats(splats, path.stem)
        shown.rotation_euler = (radians(_ROTATION_DEG[self.up]), 0.0, 0.0)
        scene_settings(context).splats = shown
        self.report({"INFO"}, f"{len(splats)} splats")
        return {"FINISHED"}
