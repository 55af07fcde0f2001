"""The hint on top of the sidebar tab: what to do next, with its button; once an avatar is shown,
what to try."""

from typing import Any

import bpy

from ..operators import ids, monitor
from ..operators.common import is_head, package, rig_or_none, scene_settings
from ..operators.open_demo import OpenDemo
from ..operators.pose import is_posing
from ..operators.training_python import has_training_python
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import modifier_input_owner
from ..stga_addon.scene.display import splat_nodes
from ..stga_addon.scene.display.splat_object import input_identifier, splat_modifier
from ..stga_addon.worker.status import WorkerState
from ..stga_addon.worker.training_python import PYTHON_VARIABLE
from .request import draw_end, draw_running
from .sidebar import SidebarPanel
from .text import draw_text
from .train_panel import draw_missing_python, draw_train_button


class NextStepPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_next_step"
    bl_label = "Next Step"

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        training, tracking = (
            monitor.state_of(context.scene, kind) for kind in (Kind.TRAINING, Kind.TRACKING)
        )
        making = monitor.state_of(context.scene, Kind.AVATAR)
        _draw_message(layout, context)
        if draw_running(layout, context, Kind.AVATAR):
            draw_text(
                layout,
                context,
                "Head, then splats appear. Go on working, save, or quit Blender",
                "INFO",
            )
            return
        if making.subject is not None:
            draw_end(layout, context, making)
            if making.snapshot.state != WorkerState.FINISHED:
                layout.operator(
                    ids.AVATAR_FROM_VIDEO, text="Continue", icon="FRAME_NEXT"
                ).folder = str(making.subject)
        if tracking.is_running:
            done = f"Tracking, {100 * tracking.snapshot.status.progress:.0f} %"
            draw_text(
                layout,
                context,
                f"{done}: the head is imported when it is done. Go on working, save, or quit "
                "Blender",
            )
        elif not is_head(settings.head) and settings.splats is None:
            draw_text(
                layout,
                context,
                "Choose a video of a face. Or import a capture: a tracked head, its cameras and "
                "their images",
            )
            draw_missing_python(layout, context)
            layout.operator(ids.AVATAR_FROM_VIDEO, text="Avatar from Video…", icon="FILE_MOVIE")
            layout.operator(ids.IMPORT_CAPTURE, icon="IMPORT")
            if OpenDemo.poll(context):
                layout.operator(ids.OPEN_DEMO, icon="USER")
        elif settings.splats is not None:
            _draw_what_to_try(layout, context, settings)
        elif training.is_running:
            draw_text(
                layout,
                context,
                "Training: splats appear on the head soon. Go on working, save, or quit Blender",
            )
        elif settings.avatar:
            draw_text(layout, context, "Show the trained avatar on the head")
            layout.operator(ids.SHOW_AVATAR, icon="HIDE_OFF").filepath = settings.avatar
        elif has_training_python(context):
            draw_text(layout, context, "Train an avatar, or choose a trained one under 4 Show")
            draw_train_button(layout, settings)
        else:
            draw_text(
                layout, context, "Training needs a Python; to show a trained avatar, go to 4 Show"
            )
            draw_missing_python(layout, context)


def _draw_message(layout: Any, context: Any) -> None:
    """Draw what the last operator could not do, as a whole, with the button that helps."""
    text = getattr(context.window_manager, ids.MESSAGE)
    if not text:
        return
    box = layout.box()
    row = box.row()
    row.label(text="Not Done", icon="ERROR")
    close = row.operator("wm.context_set_string", text="", icon="X", emboss=False)
    close.data_path, close.value = f"window_manager.{ids.MESSAGE}", ""
    draw_text(box, context, text)
    if PYTHON_VARIABLE in text:
        draw_missing_python(box, context)
    elif "FLAME model" in text:
        show = box.operator("preferences.addon_show", text="Choose It", icon="PREFERENCES")
        show.module = package()
    elif "not been saved" in text:
        box.operator("wm.save_mainfile", text="Save the File", icon="FILE_TICK")


def _draw_what_to_try(layout: Any, context: Any, settings: Any) -> None:
    """Buttons that bring a shown avatar to life."""
    layout.label(text="Orbit the avatar, or try", icon="INFO")
    playing = context.screen.is_animation_playing
    play = "Pause" if playing else "Play  (Space)"
    column = layout.column(align=True)
    column.operator("screen.animation_play", text=play, icon="PAUSE" if playing else "PLAY")
    rig = rig_or_none(settings.head)
    if rig is not None:
        posing = is_posing(context, rig)
        text = "Done Posing" if posing else "Pose the Head"
        column.operator(ids.POSE_HEAD, text=text, icon="ARMATURE_DATA", depress=posing)
        if posing:
            mouth = settings.head.data.shape_keys.key_blocks.get("jawOpen")
            if mouth is not None:
                column.prop(mouth, "value", text="Open Mouth", slider=True)
            draw_text(
                column, context, "R turns the selected bone; I keeps the pose as a keyframe", "INFO"
            )
    groups = settings.head.vertex_groups if is_head(settings.head) else ()
    if any(tags.group_timestep(group.name) is not None for group in groups):
        _draw_selection_toggle(column, settings.splats)
    draw_video(column, context)


def _draw_selection_toggle(layout: Any, splats: Any) -> None:
    """Draw the switch that grays out what the current frame's selection freezes, where the splats
    have it."""
    try:
        modifier = splat_modifier(splats)
    except StgaError:
        return
    identifier = input_identifier(modifier, splat_nodes.SHOW_SELECTION)
    if identifier is not None:
        owner, prop = modifier_input_owner(modifier, identifier)
        layout.prop(
            owner, prop, text=splat_nodes.SHOW_SELECTION, icon="RESTRICT_SELECT_OFF", toggle=True
        )


def draw_video(layout: Any, context: Any) -> None:
    """Draw the button Render Video, or what the last video has come to."""
    if draw_running(layout, context, Kind.VIDEO):
        return
    video = monitor.state_of(context.scene, Kind.VIDEO)
    if video.subject is None:
        layout.operator(ids.RENDER_VIDEO, text="Render Video…", icon="RENDER_ANIMATION")
        return
    box = draw_end(layout, context, video)
    if video.snapshot.state == WorkerState.FINISHED:
        opened = box.operator("wm.path_open", text=f"Open {video.subject.name}", icon="PLAY")
        opened.filepath = str(video.subject)
        draw_text(box, context, str(video.subject.parent), "FILE_FOLDER")
