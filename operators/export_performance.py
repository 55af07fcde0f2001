"""Exports what the head plays as curves of ARKit's shapes, for other characters."""

from functools import partial
from typing import Any, ClassVar

import bpy
from bpy_extras.io_utils import ExportHelper

from ..stga_addon.driving.inverse import captured_performance, write_performance
from ..stga_addon.scene.objects import frames_per_second
from ..stga_addon.scene.rig.motion import sample_motion
from . import ids
from .common import (
    capture_of,
    file_filter,
    file_path,
    flame_of,
    head_of,
    needs_rig,
    path_property,
    reporting,
    tell,
)


class ExportPerformance(bpy.types.Operator, ExportHelper):
    """Export expression, jaw, eyes and neck of the head in the scene's frame range as curves of
    ARKit's 52 shapes"""

    bl_idname = ids.EXPORT_PERFORMANCE
    bl_label = "Export ARKit Curves"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    filepath: path_property("File", "CSV file in Live Link Face's layout", options={"SKIP_SAVE"})
    filename_ext = ".csv"
    filter_glob: file_filter(".csv")

    poll = classmethod(needs_rig)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, scene = head_of(context), context.scene
        path = file_path(self.filepath, "curves").with_suffix(self.filename_ext)
        own = flame_of(capture_of(head), head.name)
        frames = range(scene.frame_start, scene.frame_end + 1)
        motion = sample_motion(head, own, frames, partial(tell, self, "WARNING"))
        write_performance(path, captured_performance(motion, head.name, frames_per_second(scene)))
        self.report({"INFO"}, f"Exported {len(frames)} frames to {path}")
        return {"FINISHED"}
