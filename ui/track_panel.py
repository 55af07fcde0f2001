"""The Track step: footage and head model, progress, and correction of what was tracked."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..operators import ids
from ..operators.common import is_head, scene_settings
from ..operators.environment import has_training_python
from ..operators.track import tracked_folder, tracking_snapshot
from ..operators.track_correct import tracking_keys
from ..stga_addon.requests.folder import request_folder
from ..stga_addon.scene import tags
from ..stga_addon.scene.shape_keys import has_shape_keys
from ..stga_addon.tracking.folder import SHEET_FILE
from ..stga_addon.worker.status import WorkerSnapshot, WorkerState
from .failure import draw_failure
from .sidebar import SidebarPanel
from .text import draw_text
from .train_panel import draw_environment_setup, draw_worker_progress


class TrackPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_track"
    bl_label = "Track Footage"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        layout, settings, now = self.layout, scene_settings(context), tracking_snapshot(context.scene)
        if settings.tracking_error:
            draw_text(layout, context, settings.tracking_error, "ERROR")
        if now.state.is_alive:
            _draw_progress(layout, context, now)
            return
        if now.state != WorkerState.NONE:
            _draw_end(layout, context, now)
        for name in ("footage", "footage_cameras", "head_model", "capture_folder"):
            layout.prop(settings, name)
        thing = context.view_layer.objects.active
        if not settings.head_model:
            name = thing.name if has_shape_keys(thing) else "none"
            layout.label(text=f"Shape keys of the active object: {name}", icon="SHAPEKEY_DATA")
        _draw_button(layout, settings)
        if not has_training_python(context):
            layout.label(text="No training environment yet", icon="INFO")
            draw_environment_setup(layout)


class TrackOptionsPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_track_options"
    bl_label = "Options"
    bl_parent_id = TrackPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        settings = scene_settings(context)
        for name in ("footage_start", "footage_stop", "footage_step", "focal", "detector", "mattes"):
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
        layout.operator("wm.path_open", text="Open Contact Sheet", icon="IMAGE_DATA").filepath = str(sheet)
        row = layout.row(align=True)
        row.operator(ids.VIEW_FOOTAGE, text="", icon="TRIA_LEFT").step = -1
        through = context.space_data.region_3d.view_perspective == "CAMERA"
        row.operator(ids.VIEW_FOOTAGE, icon="VIEW_CAMERA", depress=through)
        row.operator(ids.VIEW_FOOTAGE, text="", icon="TRIA_RIGHT").step = 1
        _draw_keys(layout, context, head)


def _draw_keys(layout: Any, context: Any, head: Any) -> None:
    keys = tracking_keys(head)
    layout.operator(ids.POSE_HEAD, text="Pose the Head", icon="ARMATURE_DATA")
    marked = context.scene.frame_current in keys
    text = "Unmark Key" if marked else "Mark as Key"
    layout.operator(ids.MARK_KEY, text=text, icon="KEYFRAME_HLT" if marked else "KEYFRAME", depress=marked)
    if keys:
        flow = layout.grid_flow(columns=5, align=True)
        for timestep in sorted(keys):
            jump = flow.operator(
                "wm.context_set_int", text=str(timestep), depress=timestep == context.scene.frame_current
            )
            jump.data_path, jump.value = "scene.frame_current", timestep
    layout.operator(ids.SOLVE_AGAIN, icon="FILE_REFRESH")


def _draw_button(layout: Any, settings: Any) -> None:
    track = layout.operator(ids.TRACK_FOOTAGE, text="Track", icon="CON_FOLLOWTRACK")
    track.footage, track.model, track.directory = settings.footage, settings.head_model, settings.capture_folder
    track.cameras, track.detector, track.focal = settings.footage_cameras, settings.detector, settings.focal
    track.mattes, track.matte_folder = settings.mattes, settings.matte_folder
    track.start, track.stop, track.step = settings.footage_start, settings.footage_stop, settings.footage_step


def _draw_progress(layout: Any, context: Any, now: WorkerSnapshot) -> None:
    """Draw what the worker is doing, and Cancel."""
    draw_worker_progress(layout, now)
    if now.status.detail:
        draw_text(layout, context, now.status.detail)
    layout.operator(ids.CANCEL_TRACKING, text="Cancel", icon="CANCEL")


def _draw_end(layout: Any, context: Any, now: WorkerSnapshot) -> None:
    box = layout.box()
    row = box.row()
    if now.state.failed:
        row.label(text="Tracking failed", icon="ERROR")
        draw_failure(box, context, now.status.error, now.log_tail, request_folder(tracked_folder(context.scene)))
    elif now.state == WorkerState.CANCELLED:
        row.label(text="Cancelled; Track continues", icon="INFO")
    else:
        row.label(text="Tracked", icon="CHECKMARK")
        if now.status.detail:
            draw_text(box, context, now.status.detail)
    row.operator(ids.DISMISS_TRACKING, text="", icon="X", emboss=False)
