"""Copies of avatars, and avatars on the bones of other armatures."""

from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene.display.splat_object import splats_of
from ..stga_addon.scene.duplicate import attach_to_bone, duplicate_avatar
from ..stga_addon.scene.objects import leave_edit_mode
from . import options
from .common import Edit, head_of, needs_editable_head, needs_local_head
from .options import ONCE


class DuplicateAvatar(Edit, bpy.types.Operator):
    """Copy the head with bones, sliders, keyframes and splats, beside it"""

    needs = (needs_editable_head,)

    linked: options.boolean("Linked", "Both play the same keyframes", options=ONCE)

    def run(self, context: Any) -> None:
        leave_edit_mode()
        scene = context.scene
        head = duplicate_avatar(head_of(context), self.linked)
        for selected in context.view_layer.objects.selected:
            selected.select_set(False)
        head.parent.select_set(True)
        context.view_layer.objects.active = head.parent
        scene.stga.head = head
        scene.stga.splats = next(iter(splats_of(head, scene)), None)


class AttachToBone(Edit, bpy.types.Operator):
    """Let the avatar follow a bone of another armature, such as a body's neck, from where it is
    now; its own bones stay"""

    bl_label = "Attach to Bone"
    needs = (needs_local_head,)

    armature: options.text("Armature", "Name of the armature; empty: detach", options=ONCE)
    bone: options.text("Bone", "Name of the bone", options=ONCE)

    def run(self, context: Any) -> None:
        armature = context.scene.objects.get(self.armature)
        if self.armature and (armature is None or armature.type != "ARMATURE"):
            raise StgaError(f"{self.armature}: is no armature of the scene")
        attach_to_bone(head_of(context), armature, self.bone if armature is not None else "")
