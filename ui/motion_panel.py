"""The Motion step: applying the motion of others, sliders of the face, and driving the head by a
phone or program."""

from time import monotonic
from typing import Any

import bpy

from ..operators import drive
from ..operators.common import rig_or_none, rig_problem
from ..operators.pose import needs_sliders, preparing
from ..stga_addon.driving.live.sources import LOOPBACK, SOURCES
from ..stga_addon.driving.performance import ARKIT_SHAPES
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene.objects import mover_of
from ..stga_addon.scene.rig.keyframes import EXPRESSION_KEY, IDENTITY_KEY
from ..stga_addon.scene.rig.motion import outside_now, stored_range
from ..stga_addon.scene.rig.poses import poses
from ..stga_addon.scene.tags import is_head
from .sidebar import ClosedPanel, HeadPanel, SidebarPanel, draw_running, draw_text

MAX_SLIDERS = 10  # the first components vary most
SILENT_S = 1.0


class MotionPanel(SidebarPanel, bpy.types.Panel):
    bl_label = "5 Motion"

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = context.scene.stga
        layout.operator("stga.apply_motion", text="Apply Motion…", icon="IMPORT")
        if problem := rig_problem(settings.head):
            draw_text(layout, context, problem, "ERROR")
        row = layout.row(align=True)
        other = settings.motion_source
        row.prop(settings, "motion_source")
        if other is not None:
            row.operator("stga.apply_motion", text="", icon="CHECKMARK").source = other.name
        if not is_head(settings.head):
            return
        root = mover_of(settings.head)
        if root.parent_type == "BONE":
            text = f"Detach from {root.parent_bone}"
            layout.operator("stga.attach_to_bone", text=text, icon="UNLINKED")
            return
        layout.prop(settings, "body")
        if settings.body is not None:
            row = layout.row(align=True)
            row.prop_search(settings, "body_bone", settings.body.data, "bones", text="")
            attach = row.operator("stga.attach_to_bone", icon="LINKED")
            attach.armature = settings.body.name
            attach.bone = settings.body_bone


class FacePanel(SidebarPanel, bpy.types.Panel):
    bl_label = "Face Shapes"
    bl_parent_id = MotionPanel.bl_idname

    @classmethod
    def poll(cls, context: Any) -> bool:
        return rig_or_none(context.scene.stga.head) is not None

    def draw(self, context: Any) -> None:
        head = context.scene.stga.head
        if head.session_uid in preparing:
            self.layout.label(text="Sliders follow in a moment", icon="TIME")
            return
        if needs_sliders(head):
            self.layout.operator("stga.add_arkit_controls", icon="ADD")
            return
        if rig_or_none(head) is None:
            return
        keys = head.data.shape_keys.key_blocks
        column = self.layout.column(align=True)
        for name in [name for name in ARKIT_SHAPES if name in keys]:
            column.prop(keys[name], "value", text=name, slider=True)


class PosesPanel(HeadPanel, bpy.types.Panel):
    """Poses of the asset browser, a button each."""

    bl_label = "Poses"
    bl_parent_id = MotionPanel.bl_idname

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = context.scene.stga
        row = layout.row(align=True)
        row.prop(settings, "pose_strength", slider=True)
        row.prop(settings, "key_pose", text="", icon="KEY_HLT", toggle=True)
        grid = layout.grid_flow(columns=2, align=True)
        for action in poses():
            button = grid.operator("stga.apply_pose", text=action.name)
            button.pose = action.name
            button.strength = settings.pose_strength
            button.keyframe = settings.key_pose
        row = layout.row(align=True)
        row.operator("stga.save_pose", text="Save Pose…", icon="ADD")
        row.operator("stga.mirror_pose", icon="MOD_MIRROR")


class TrainedPanel(ClosedPanel, bpy.types.Panel):
    """Meters of how far outside the trained range the head is posed in this frame."""

    bl_label = "Trained Range"
    bl_parent_id = MotionPanel.bl_idname

    def draw(self, context: Any) -> None:
        head = context.scene.stga.head
        rig = rig_or_none(head)
        trained = stored_range(head) if rig is not None else None
        if trained is None:
            self.layout.operator("stga.measure_range", icon="DRIVER_DISTANCE")
            return
        for part, beyond in outside_now(head, rig, trained).items():
            where = f"{beyond:.1f} half widths outside" if beyond else "inside"
            self.layout.progress(factor=min(beyond, 1.0), text=f"{part.capitalize()}: {where}")


class CoefficientsPanel(ClosedPanel, bpy.types.Panel):
    """Sliders of a FLAME head without names: of expression, and of other persons."""

    bl_label = "Coefficients"
    bl_parent_id = MotionPanel.bl_idname

    @classmethod
    def poll(cls, context: Any) -> bool:
        return bool(_coefficients(context.scene.stga.head))

    def draw(self, context: Any) -> None:
        for keys in _coefficients(context.scene.stga.head):
            column = self.layout.column(align=True)
            for key in keys[:MAX_SLIDERS]:
                column.prop(key, "value", text=key.name, slider=True)


def _coefficients(head: Any) -> list[list[Any]]:
    if not is_head(head) or head.data.shape_keys is None:
        return []
    keys = head.data.shape_keys.key_blocks
    prefixes = (EXPRESSION_KEY, IDENTITY_KEY)
    found = [[key for key in keys if key.name.startswith(prefix)] for prefix in prefixes]
    return [part for part in found if part]


class DrivePanel(ClosedPanel, bpy.types.Panel):
    bl_label = "Drive"
    bl_parent_id = MotionPanel.bl_idname

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = context.scene.stga.drive
        running = drive.session()
        if running is None:
            source = SOURCES[settings.source]
            layout.prop(settings, "source")
            if source.request:
                layout.prop(settings, "phone")
            layout.prop(settings, "address")
            layout.prop(settings, "port", text=f"Port (0: {source.port})")
            draw_text(layout, context, source.hint)
            if settings.address == LOOPBACK:
                hint = "Only programs on this computer are heard; for a phone, listen on 0.0.0.0"
                draw_text(layout, context, hint)
            layout.operator("stga.drive_live", icon="PLAY")
        else:
            layout.operator("stga.stop_live", icon="PAUSE")
            _draw_status(layout.column(align=True), running)
            row = layout.row(align=True)
            row.operator("stga.calibrate_live", icon="PIVOT_ACTIVE")
            recording = running.recording
            text = "Record" if recording is None else f"Stop Recording ({len(recording)})"
            row.operator("stga.record_live", text=text, icon="REC", depress=recording is not None)
        column = layout.column(align=True)
        for name in ("strength", "smoothing", "stay_trained", "mirror"):
            column.prop(settings, name)
        row = column.row(align=True)
        row.prop(settings, "exchange_jaw", text="Swap Jaw", toggle=True)
        row.prop(settings, "exchange_mouth", text="Swap Mouth", toggle=True)
        layout.prop(settings, "takes")
        if not draw_running(layout, context, Kind.PERFORMANCE):
            layout.operator("stga.drive_video", text="Drive from Video…", icon="FILE_MOVIE")


def _draw_status(column: Any, running: Any) -> None:
    now = monotonic()
    stream = running.stream
    silent = stream.silent_s(now)
    delay_s = stream.delay_s()
    if silent is None:
        column.label(text=f"Waiting on port {running.receiver.port}", icon="INFO")
    elif silent > SILENT_S:
        column.label(text=f"Nothing received for {silent:.0f} s", icon="ERROR")
    elif not stream.has_face:
        column.label(text="No face in the picture", icon="ERROR")
    else:
        column.label(text=f"{stream.rate(now):.0f} packets per second", icon="CHECKMARK")
    lost = "not numbered" if delay_s is None else str(stream.lost)
    column.label(text=f"Lost: {lost}   Late: {stream.late}   Foreign: {stream.foreign}")
    delay = "no clock" if delay_s is None else f"+{1000 * delay_s:.0f} ms"
    slowest_ms = 1000 * max(running.ticks_s, default=0.0)
    column.label(text=f"Network: {delay}   Slowest pose: {slowest_ms:.0f} ms")
    for sender in sorted(stream.senders) if len(stream.senders) > 1 else ():
        row = column.row()
        row.label(text=" ".join(filter(None, sender)))
        button = row.operator("stga.follow_live", depress=sender == stream.followed)
        button.address, button.subject = sender
