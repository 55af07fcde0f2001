"""The Track step: footage and head model, progress, and correction of what was tracked."""

from typing import Any

import bpy

from ..operators import monitor
from ..operators.track import TrackOptions, tracking_keys
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.scene.record import capture_of
from ..stga_addon.scene.tags import is_head
from ..stga_addon.tracking.folder import SHEET_FILE
from .sidebar import ClosedPanel, SidebarPanel, draw_end, draw_running, draw_text, set_options
from .train_panel import draw_missing_python


class TrackPanel(ClosedPanel, bpy.types.Panel):
    bl_label = "Track Footage"

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = context.scene.stga.track
        if draw_running(layout, context, Kind.TRACKING):
            return
        tracking = monitor.state_of(context.scene, Kind.TRACKING)
        if tracking.subject is not None:
            box = draw_end(layout, context, tracking)
            draw_text(box, context, tracking.snapshot.status.detail)
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        for name in ("footage", "cameras", "model", "avatar", "directory"):
            column.prop(settings, name)
        text = "Track with Avatar" if settings.avatar else "Track"
        track = layout.operator("stga.track_footage", text=text, icon="CON_FOLLOWTRACK")
        set_options(track, settings, TrackOptions)
        draw_missing_python(layout, context)


class TrackOptionsPanel(ClosedPanel, bpy.types.Panel):
    bl_label = "Options"
    bl_parent_id = TrackPanel.bl_idname

    def draw(self, context: Any) -> None:
        settings = context.scene.stga.track
        for name in ("start", "stop", "step", "focal", "mattes", "matte_folder"):
            if name != "matte_folder" or settings.mattes == "folder":
                self.layout.prop(settings, name)


class TrackCheckPanel(SidebarPanel, bpy.types.Panel):
    bl_label = "Check and Correct"
    bl_parent_id = TrackPanel.bl_idname

    @classmethod
    def poll(cls, context: Any) -> bool:
        head = context.scene.stga.head
        return is_head(head) and bool(head.get(tags.TRACKED))

    def draw(self, context: Any) -> None:
        layout = self.layout
        head = context.scene.stga.head
        sheet = layout.operator("wm.path_open", text="Open Contact Sheet", icon="IMAGE_DATA")
        sheet.filepath = str(capture_of(head) / SHEET_FILE)
        lens = head.get(tags.FOCAL_LENGTH)
        if lens:
            draw_text(layout, context, f"Focal length: {lens}", "CAMERA_DATA")
        row = layout.row(align=True)
        row.operator("stga.view_footage", text="", icon="TRIA_LEFT").step = -1
        through = context.space_data.region_3d.view_perspective == "CAMERA"
        row.operator("stga.view_footage", icon="VIEW_CAMERA", depress=through)
        row.operator("stga.view_footage", text="", icon="TRIA_RIGHT").step = 1
        layout.operator("stga.pose_head", icon="ARMATURE_DATA")
        keys = tracking_keys(head)
        now = context.scene.frame_current
        text, icon = ("Unmark Key", "KEYFRAME_HLT") if now in keys else ("Mark as Key", "KEYFRAME")
        layout.operator("stga.mark_key", text=text, icon=icon, depress=now in keys)
        if keys:
            flow = layout.grid_flow(columns=5, align=True)
            for timestep in sorted(keys):
                at = {"text": str(timestep), "depress": timestep == now}
                jump = flow.operator("wm.context_set_int", **at)
                jump.data_path = "scene.frame_current"
                jump.value = timestep
        layout.operator("stga.solve_again", icon="FILE_REFRESH")
