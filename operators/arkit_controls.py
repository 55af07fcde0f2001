"""Adds and removes sliders named as ARKit's blend shapes."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.driving.head_map import head_map
from ..stga_addon.scene.rig.arkit import add_controls, has_controls, remove_controls
from ..stga_addon.scene.rig.flame_rig import rig_of
from . import ids
from .common import capture_of, flame_of, head_of, needs_rig, reporting, rig_or_none, scene_settings


class AddArkitControls(bpy.types.Operator):
    """Add 52 sliders named as ARKit's blend shapes, which drive expressions, jaw and eyes without
    Python"""

    bl_idname = ids.ADD_ARKIT_CONTROLS
    bl_label = "Add ARKit Controls"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    poll = classmethod(needs_rig)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        add_controls(head, rig_of(head), head_map(flame_of(capture_of(head), head.name), head.name))
        return {"FINISHED"}


class RemoveArkitControls(bpy.types.Operator):
    """Remove the ARKit sliders and their keyframes; expressions, jaw and eyes play their own
    animation again"""

    bl_idname = ids.REMOVE_ARKIT_CONTROLS
    bl_label = "Remove ARKit Controls"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if not needs_rig(cls, context):
            return False
        rig = rig_or_none(scene_settings(context).head)
        return rig is not None and has_controls(rig)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        remove_controls(head, rig_of(head))
        return {"FINISHED"}
