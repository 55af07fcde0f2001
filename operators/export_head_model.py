"""Exports a mesh object with shape keys as a linear head model, which footage can be tracked
with."""

from typing import Any, ClassVar

import bpy
from bpy_extras.io_utils import ExportHelper

from ..stga_addon.scene.rig.head import has_shape_keys, shape_key_model
from ..stga_addon.tracking.head_model import shape_arrays, write_linear_model
from . import ids
from .common import file_filter, file_path, polled, reporting


class ExportHeadModel(bpy.types.Operator, ExportHelper):
    """Export the active object's shape keys as a head model for tracking; keys named identity… make
    other persons"""

    bl_idname = ids.EXPORT_HEAD_MODEL
    bl_label = "Export Head Model"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    filename_ext = ".npz"
    filter_glob: file_filter(".npz")

    @classmethod
    def poll(cls, context: Any) -> bool:
        return polled(cls, has_shape_keys(context.active_object), "Select a mesh with shape keys")

    @reporting
    def execute(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "head model")
        write_linear_model(path, shape_arrays(*shape_key_model(context.active_object)))
        return {"FINISHED"}
