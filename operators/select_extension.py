"""Selects, frame by frame, the triangles that extending a run by this take would train, before
anything is trained."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.jobs.table import Kind
from ..stga_addon.jobs.train import SelectForTake
from . import ids
from .common import capture_source, file_path, head_of, needs_own_head, path_property, reporting
from .request import needs_idle, start
from .training_python import training_python


class SelectExtension(bpy.types.Operator):
    """Select the triangles that extending the run by this head's take would train in each frame:
    those that move, and those that look different than in the run's images"""

    bl_idname = ids.SELECT_EXTENSION
    bl_label = "Select for Extend"
    # the selection, which comes later, is the step to undo
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    directory: path_property("Run Folder", "Folder of the run to extend", "DIR_PATH")

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.SELECTION) and needs_own_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, run = head_of(context), file_path(self.directory, "run folder")
        take, flame, _ = capture_source(head)
        start(context.scene, SelectForTake(run, take, flame), training_python(context))
        return {"FINISHED"}
