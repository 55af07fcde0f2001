"""The Track step: footage and head model, progress, and correction of what was tracked."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..operators import ids, monitor
from ..operators.common import is_head, scene_settings
from ..operators.track import TrackOptions
from ..operators.track_correct import tracking_keys
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.tracking.folder import SHEET_FILE
from .options import set_options
from .request import draw_end, draw_running
from .sidebar import SidebarPanel
from .text import draw_text
from .train_panel import draw_missing_python


class TrackPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_track"
    bl_label = "Track Footage"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        if draw_running(layout, context, Kind.TRACKING):
            return
        tracking = monitor.state_of(context.scene, Kind.TRACKING)
        if tracking.subject is not None:
            box = draw_end(layout, context, tracking)
            draw_text(box, context, tracking.snapshot.status.detail)
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        for name in ("footage", "cameras", "model", "avatar", "directory"):
            column.prop(settings.track, name)
        text = "Track with Avatar" if settings.track.avatar else "Track"
        track = layout.operator(ids.TRACK_FOOTAGE, text=text, icon="CON_FOLLOWTRACK")
        set_options(track, settings.track, TrackOptions)
        draw_missing_python(layout, context)


class TrackOptionsPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_track_options"
    bl_label = "Options"
    bl_parent_id = TrackPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        settings = scene_settings(context).track
        for name in ("start", "stop", "step", "focal", "mattes"):
            self.layout.prop(settings, name)
        if settings.mattes == "folder":
            self.layout.prop(settings, "matte_folder")


class TrackCheckPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_track_check"
    bl_label = "Check and Correct"
    bl_parent_id = TrackPanel.bl_idname

    @classmethod
    def poll(cls, context: Any) -> bool:
        head = scene_settings(context).head
        return is_head(head) and bool(head.get(tags.TRACKED))

    def draw(self, context: Any) -> None:
        layout, head = self.layout, scene_settings(context).head
        sheet = Path(head[tags.CAPTURE]) / SHEET_FILE
        layout.operator(
            "wm.path_open", text="Open Contact Sheet", icon="IMAGE_DATA"
        ).filepath = str(sheet)
        row = layout.row(align=True)
        row.operator(ids.VIEW_FOOTAGE, text="", icon="TRIA_LEFT").step = -1
        through = context.space_data.region_3d.view_perspective == "CAMERA"
        row.operator(ids.VIEW_FOOTAGE, icon="VIEW_CAMERA", depress=through)
        row.operator(ids.VIEW_FOOTAGE, text="", icon="TRIA_RIGHT").step = 1
        _draw_keys(layout, context, head)


def _draw_keys(layout: Any, context: Any, head: Any) -> None:
    keys = tracking_keys(head)
    layout.operator(ids.POSE_HEAD, icon="ARMATURE_DATA")
    marked = context.scene.frame_current in keys
    text = "Unmark Key" if marked else "Mark as Key"
    layout.operator(
        ids.MARK_KEY, text=text, icon="KEYFRAME_HLT" if marked else "KEYFRAME", depress=marked
    )
    if keys:
        flow = layout.grid_flow(columns=5, align=True)
        for timestep in sorted(keys):
            jump = flow.operator(
                "wm.context_set_int",
                text=str(timestep),
                depress=timestep == context.scene.frame_current,
            )
            jump.data_path, jump.value = "scene.frame_current", timestep
    layout.operator(ids.SOLVE_AGAIN, icon="FILE_REFRESH")
