"""Enters and leaves Pose mode on the head's rig."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import select_bones
from ..stga_addon.scene.objects import leave_edit_mode, show_kind
from ..stga_addon.scene.rig.head import rig_of
from ..stga_addon.scene.rig.keyframes import posing_bone
from . import ids
from .common import head_of, needs_rig, reporting


class PoseHead(bpy.types.Operator):
    """Show the bones and select one in Pose mode; again: back to Object mode. R turns a bone, I
    keeps its pose"""

    bl_idname = ids.POSE_HEAD
    bl_label = "Pose the Head"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    poll = classmethod(needs_rig)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, objects = head_of(context), context.view_layer.objects
        rig = rig_of(head)
        was_posing = is_posing(context, rig)
        leave_edit_mode()
        show_kind(head.parent, tags.RIG, context.view_layer, not was_posing)
        if was_posing:
            return {"FINISHED"}
        rig.hide_set(False)
        if not rig.visible_get(view_layer=context.view_layer):
            raise StgaError(f"{rig.name}: is hidden; show its collection in the Outliner")
        for selected in objects.selected:
            selected.select_set(False)
        rig.select_set(True)
        objects.active = rig
        bpy.ops.object.mode_set(mode="POSE")
        bone = posing_bone(head)
        select_bones(rig, {bone})
        rig.data.bones.active = rig.data.bones[bone]
        if context.area is not None and context.area.type == "VIEW_3D":
            bpy.ops.wm.tool_set_by_id(name="builtin.rotate")
        return {"FINISHED"}


class TurnJaw(bpy.types.Operator):
    """Open and close the mouth: R turns the jaw about its hinge, from whatever side it is seen"""

    bl_idname = ids.TURN_JAW
    bl_label = "Turn the Jaw"
    bl_options: ClassVar[set[str]] = {"INTERNAL"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        chosen = [bone.name for bone in context.selected_pose_bones or ()]
        return chosen == ["jaw"] and context.active_object.get(tags.KIND) == tags.RIG

    def invoke(self, context: Any, event: Any) -> set[str]:
        hinge = (True, False, False)
        bpy.ops.transform.rotate("INVOKE_DEFAULT", orient_type="LOCAL", constraint_axis=hinge)
        return {"FINISHED"}


def is_posing(context: Any, rig: Any) -> bool:
    """Whether this rig is in Pose mode."""
    return context.view_layer.objects.active is rig and rig.mode == "POSE"


_keymap_items: list[tuple[Any, Any]] = []


def register() -> None:
    """R turns a jaw about its hinge; without a window, Blender has no keys."""
    keys = bpy.context.window_manager.keyconfigs.addon
    if keys is not None:
        keymap = keys.keymaps.new(name="Pose")
        _keymap_items.append((keymap, keymap.keymap_items.new(ids.TURN_JAW, "R", "PRESS")))


def unregister() -> None:
    for keymap, item in _keymap_items:
        keymap.keymap_items.remove(item)
    _keymap_items.clear()
