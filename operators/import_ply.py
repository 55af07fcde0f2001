"""World-space 3D Gaussian Splatting PLY → splats."""

from math import radians
from typing import Any, ClassVar

import bpy

from ..stga_addon.avatar.ply import read_ply
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.display.splat_object import show_world_splats
from . import ids
from .common import file_path, reporting, scene_settings

# Rotation about x in degrees that turns the file's up axis to Blender's.
_TURN = {"Y": 90.0, "-Y": -90.0, "Z": 0.0}


class ImportPly(bpy.types.Operator):
    """Import a 3D Gaussian Splatting PLY as splats"""

    bl_idname = ids.IMPORT_PLY
    bl_label = "Import Gaussian Splats"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(
        name="File", description="3D Gaussian Splatting PLY", subtype="FILE_PATH", options=PATH_OPTIONS
    )
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})
    up: bpy.props.EnumProperty(
        name="Up",
        description="The axis of the file that points up",
        items=(
            ("Y", "Y", "Captures tracked with FLAME, and what this add-on exports"),
            ("-Y", "-Y", "Scenes reconstructed with COLMAP"),
            ("Z", "Z", "Blender's own"),
        ),
    )

    def invoke(self, context: Any, event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "PLY")
        splats = read_ply(path)
        shown = show_world_splats(splats, path.stem)
        shown.rotation_euler = (radians(_TURN[self.up]), 0.0, 0.0)
        scene_settings(context).splats = shown
        self.report({"INFO"}, f"{len(splats)} splats")
        return {"FINISHED"}
