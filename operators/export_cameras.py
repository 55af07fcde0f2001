"""Exports the scene's cameras for tracking."""

from typing import Any, ClassVar

import bpy
from bpy_extras.io_utils import ExportHelper

from ..stga_addon.scene.cameras import export_cameras
from . import ids
from .common import file_filter, file_path, path_property, reporting


class ExportCameras(bpy.types.Operator, ExportHelper):
    """Export cameras at the current frame as calibration of footage: each has a folder, video or
    image of its name"""

    bl_idname = ids.EXPORT_CAMERAS
    bl_label = "Export Cameras"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    filename_ext = ".json"
    filepath: path_property(
        "File", "transforms.json in the folder of the footage", options={"SKIP_SAVE"}
    )
    filter_glob: file_filter(".json")
    selected_only: bpy.props.BoolProperty(
        name="Selected Only", description="Export selected cameras instead of all in the scene"
    )

    @reporting
    def execute(self, context: Any) -> set[str]:
        objects = context.selected_objects if self.selected_only else context.scene.objects
        cameras = [thing for thing in objects if thing.type == "CAMERA"]
        path = file_path(self.filepath, "export")
        count = export_cameras(path, cameras, context.evaluated_depsgraph_get())
        self.report({"INFO"}, f"Exported {count} cameras to {path}")
        return {"FINISHED"}
