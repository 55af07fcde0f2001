"""Posing the head by hand: Pose mode on its rig, and sliders named as ARKit's blend shapes."""

from contextlib import suppress
from threading import Thread
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..stga_addon.capture.open import open_capture
from ..stga_addon.driving.head_map import head_map
from ..stga_addon.errors import StgaError, shorten
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import select_bones
from ..stga_addon.scene.objects import Identity, leave_edit_mode, local_scenes, show_kind
from ..stga_addon.scene.rig import keyframes, poses
from ..stga_addon.scene.rig.head import usable_rig
from ..stga_addon.scene.rig.motion import mirror_pose
from . import common, options, timers
from .common import (
    AtEnd,
    Edit,
    head_of,
    need,
    needs_bones,
    needs_editable_head,
    needs_rig,
    needs_rig_or_shapes,
    rig_or_none,
    rig_or_shapes,
)
from .options import FACTOR, ONCE
from .windows import push_undo, redraw

POLL_INTERVAL_S = 0.3


class PoseHead(Edit, bpy.types.Operator):
    """Show the bones and select one in Pose mode; again: back to Object mode. R turns a bone, I
    keeps its pose"""

    bl_label = "Pose the Head"
    needs = (needs_bones,)

    def run(self, context: Any) -> None:
        head = head_of(context)
        objects = context.view_layer.objects
        rig = usable_rig(head, with_sliders=False)
        was_posing = is_posing(context, rig)
        leave_edit_mode()
        show_kind(head.parent, tags.RIG, context.view_layer, not was_posing)
        if was_posing:
            return
        rig.hide_set(False)
        if not rig.visible_get(view_layer=context.view_layer):
            raise StgaError(f"{rig.name}: is hidden; show its collection in the Outliner")
        for selected in objects.selected:
            selected.select_set(False)
        rig.select_set(True)
        objects.active = rig
        bpy.ops.object.mode_set(mode="POSE")
        bone = keyframes.posing_bone(head)
        select_bones(rig, {bone})
        rig.data.bones.active = rig.data.bones[bone]
        if context.area is not None and context.area.type == "VIEW_3D":
            bpy.ops.wm.tool_set_by_id(name="builtin.rotate")


class TurnJaw(bpy.types.Operator):
    """Open and close the mouth: R turns the jaw about its hinge, from whatever side it is seen"""

    bl_idname = "stga.turn_jaw"
    bl_label = "Turn the Jaw"
    bl_options = frozenset({"INTERNAL"})

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


class MirrorPose(Edit, bpy.types.Operator):
    """Swap left and right of the pose: bones, and sliders named as ARKit's blend shapes"""

    needs = (needs_rig,)

    def run(self, context: Any) -> None:
        head = head_of(context)
        if not mirror_pose(head, usable_rig(head)):
            self.warn(
                f"{head.name}: has no sliders of a left and a right; only bones were mirrored"
            )


# Poses


class SavePose(Edit, bpy.types.Operator):
    """Store the pose in the asset browser: sliders that are not 0, and bones that are turned"""

    needs = (needs_rig_or_shapes,)

    name: options.text("Name", "Name of the pose", default="Pose", options=ONCE)
    sliders: options.boolean("Sliders", "Store sliders that are not 0", default=True, options=ONCE)
    bones: options.boolean(
        "Bones",
        "Store neck, jaw and eyes as far as they are turned; not where the head is",
        default=True,
        options=ONCE,
    )

    def invoke(self, context: Any, event: Any) -> set[str]:
        chosen: set[str] = context.window_manager.invoke_props_dialog(self)
        return chosen

    def run(self, context: Any) -> None:
        head = head_of(context)
        parts = [part for part in poses.PARTS if getattr(self, part)]
        action = poses.save_pose(head, rig_or_shapes(head), self.name, parts)
        self.inform(f"{action.name}: is in the asset browser, and in Poses")


def _list_poses(owner: Any, context: Any, text: str) -> list[str]:
    return [action.name for action in poses.poses()]


class ApplyPose(Edit, bpy.types.Operator):
    """Give the head a pose of the asset browser; sliders and bones that are not in it stay"""

    needs = (needs_rig_or_shapes,)

    pose: options.text("Pose", "Name of the pose", search=_list_poses, options=ONCE)
    strength: options.number(
        "Strength", "1: the pose; 0.5: halfway to it", default=1.0, **FACTOR, options=ONCE
    )
    keyframe: options.boolean(
        "Keyframe", "Keyframe what the pose changes, in the current frame", options=ONCE
    )

    def run(self, context: Any) -> None:
        head = head_of(context)
        rig = rig_or_shapes(head)
        action = next((each for each in poses.poses() if each.name == self.pose), None)
        if action is None:
            raise StgaError(f"{self.pose}: is no pose of this file; save one, or append one")
        keyed = self.keyframe or context.scene.tool_settings.use_keyframe_insert_auto
        for owner in filter(None, (rig, head.data.shape_keys) if keyed else ()):
            keyframes.check_keyable_action(owner)
        applied = poses.apply_pose(head, rig, action, self.strength)
        for key in applied.sliders if keyed else ():
            key.keyframe_insert("value")
        for bone in applied.bones if keyed else ():
            bone.keyframe_insert("rotation_quaternion")
        if applied.missing:
            lacks = f"lacks {shorten(', '.join(applied.missing))} of the pose {action.name}"
            self.warn(f"{head.name}: {lacks}; the rest was applied")


# Sliders


class AddArkitControls(Edit, bpy.types.Operator):
    """Add 52 sliders named as ARKit's blend shapes: jawOpen, mouthSmileLeft, …"""

    bl_label = "Add Face Sliders"

    needs = (
        needs_rig,
        needs_editable_head,
        need(
            lambda context: keyframes.EXPRESSION_NAMES not in context.scene.stga.head,
            "The head has its sliders",
        ),
    )

    def run(self, context: Any) -> None:
        head = head_of(context)
        keyframes.add_shapes(head, *_compute_shapes(common.capture_source(head), head.name))
        poses.bring_presets(head)


def _compute_shapes(source: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    """What `add_shapes` takes: seconds of work. Raises StgaError for a head whose face ARKit's
    shapes do not fit."""
    sequence = open_capture(*source).flame_motion(name)
    found = head_map(sequence, name)
    return found, *keyframes.head_shapes(sequence, found)


def needs_sliders(head: Any) -> bool:
    """Whether a head has neither expressions with ARKit's names nor the sliders."""
    if rig_or_none(head) is None or head.data.override_library is not None:
        return False
    return keyframes.EXPRESSION_NAMES not in head and not keyframes.has_shapes(head)


def begin_sliders(head: Any) -> None:
    """Give a head that needs them its sliders as soon as a thread has computed them, and any its
    map, for which *Drive Live* would wait; scripts call the operators."""
    if timers.has_timer() and rig_or_none(head) is not None and head.library is None:
        timers.watch(_Sliders(head))


preparing: set[int] = set()
"""Session ids of heads whose sliders are being computed."""


class _Sliders:
    """What a thread computes for a head."""

    def __init__(self, head: Any) -> None:
        self._head = Identity(head)
        self._made = list[Any]()
        arguments = common.capture_source(head), needs_sliders(head)
        self._thread = Thread(target=self._make, args=arguments, daemon=True)
        self._thread.start()
        if needs_sliders(head):
            preparing.add(self._head.uid)

    def _make(self, source: tuple[Any, ...], has_none: bool) -> None:
        with suppress(StgaError):  # the operator says what is wrong
            if has_none:
                self._made.append(_compute_shapes(source, self._head.name))
            else:
                name = self._head.name
                head_map(open_capture(*source).flame_motion(name), name)

    def tick(self) -> float | None:
        if self._thread.is_alive() or bpy.app.is_job_running("RENDER"):
            return POLL_INTERVAL_S
        preparing.discard(self._head.uid)
        head = self._head.find()
        if self._made and needs_sliders(head):
            if head.mode == "EDIT":
                return POLL_INTERVAL_S
            keyframes.add_shapes(head, *self._made[0])
            poses.bring_presets(head)
            push_undo()
            redraw()
        return None

    def close(self) -> None:
        preparing.discard(self._head.uid)


@persistent
def _after_load(_: Any) -> None:
    for scene in local_scenes():
        begin_sliders(scene.stga.head)


def register(at_end: AtEnd) -> None:
    common.register_handlers(at_end, (bpy.app.handlers.load_post, _after_load))
