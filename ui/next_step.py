"""The hint on top of the sidebar tab: what to do next, with its button; once an avatar is shown,
what to try."""

from contextlib import suppress
from typing import Any

import bpy

from ..operators import monitor
from ..operators.common import UNSAVED, rig_or_none
from ..operators.import_capture import OpenDemo
from ..operators.pose import is_posing
from ..operators.training_python import has_training_python
from ..stga_addon.capture.repairs import REPAIR_OPTION
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.scene.display import splat_nodes
from ..stga_addon.scene.display.splat_object import (
    get_input,
    is_partly_observed,
    splat_modifier,
)
from ..stga_addon.scene.tags import is_head
from ..stga_addon.worker.status import WorkerState
from ..stga_addon.worker.training_python import PYTHON_VARIABLE
from .select_panel import has_selection
from .show_panel import draw_input, draw_left_out
from .sidebar import SidebarPanel, draw_end, draw_running, draw_text
from .train_panel import (
    draw_missing_python,
    draw_preferences,
    draw_repair,
    draw_train_button,
)

FILM_MORE = (
    "Blue parts were not filmed; their colors are guesses. To capture them, film once around the "
    "person, who keeps still, and make the avatar from both videos"
)
GO_ON = "Go on working, save, or quit Blender"


class NextStepPanel(SidebarPanel, bpy.types.Panel):
    bl_label = "Next Step"

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = context.scene.stga
        scene = context.scene
        _draw_message(layout, context)
        if draw_running(layout, context, Kind.AVATAR):
            draw_text(layout, context, f"The head appears first, then splats. {GO_ON}", "INFO")
            return
        making = monitor.state_of(scene, Kind.AVATAR)
        if making.subject is not None:
            draw_end(layout, context, making)
            if making.snapshot.state != WorkerState.FINISHED:
                make = "stga.avatar_from_video"
                button = layout.operator(make, text="Continue", icon="FRAME_NEXT")
                button.folder = str(making.subject)
        tracking = monitor.state_of(scene, Kind.TRACKING)
        if tracking.is_running:
            done = f"Tracking, {100 * tracking.snapshot.status.progress:.0f} %"
            draw_text(layout, context, f"{done}: the head is imported at the end. {GO_ON}")
        elif not is_head(settings.head) and settings.splats is None:
            tracked = "a tracked head, its cameras and their images"
            has_demo = OpenDemo.poll(context)
            lack = "" if has_demo else " (this edition has no demo)"
            hint = f"Choose a video of a face{lack}. Or import a capture: {tracked}"
            first = "" if has_training_python(context) else "Choose a Python with PyTorch first. "
            draw_text(layout, context, first + hint)
            draw_missing_python(layout, context)
            text = "Avatar from Video…"
            icon = "FILE_MOVIE"
            layout.operator("stga.avatar_from_video", text=text, icon=icon)
            layout.operator("stga.import_capture", icon="IMPORT")
            if has_demo:
                layout.operator("stga.open_demo", icon="USER")
                shot = layout.operator("stga.open_demo", text="Open Demo Shot", icon="SCENE")
                shot.shot = True
        elif monitor.state_of(scene, Kind.TRAINING).is_running:
            appear = "splats appear on the head soon"
            done = appear if settings.splats is None else "the splats improve as it goes on"
            draw_text(layout, context, f"Training: {done}. {GO_ON}")
        elif settings.splats is not None:
            _draw_what_to_try(layout, context, settings)
        elif settings.avatar:
            draw_text(layout, context, "Show the trained avatar on the head")
            layout.operator("stga.show_avatar", icon="HIDE_OFF").filepath = settings.avatar
        elif has_training_python(context):
            _draw_training(layout, context, settings)
        else:
            hint = "Training needs a Python; to show a trained avatar, go to 4 Show"
            draw_text(layout, context, hint)
            draw_missing_python(layout, context)


def _draw_training(layout: Any, context: Any, settings: Any) -> None:
    """Draw why the last training failed, then the button that repairs or trains."""
    last = monitor.state_of(context.scene, Kind.TRAINING).snapshot
    if last.state.failed:
        draw_text(layout, context, last.status.error, "ERROR")
    if last.state.failed and REPAIR_OPTION in last.status.error:
        draw_repair(layout)
        return
    draw_text(layout, context, "Train an avatar, or choose a trained one under 4 Show")
    draw_train_button(layout, settings)


def _draw_message(layout: Any, context: Any) -> None:
    """Draw what the last operator could not do, or there is to know of what it did, as a whole,
    with the button that helps."""
    text = context.window_manager.stga_message
    failed = context.window_manager.stga_failed
    if not text:
        return
    box = layout.box()
    row = box.row()
    row.label(text="Not Done" if failed else "Done", icon="ERROR" if failed else "INFO")
    close = row.operator("wm.context_set_string", text="", icon="X", emboss=False)
    close.data_path = "window_manager.stga_message"
    close.value = ""
    for sentence in text.splitlines():
        draw_text(box, context, sentence)
    if PYTHON_VARIABLE in text:
        draw_missing_python(box, context)
    elif "FLAME model" in text:
        draw_preferences(box, "Choose It")
    elif UNSAVED in text:
        box.operator("wm.save_mainfile", text="Save the File", icon="FILE_TICK")


def _draw_what_to_try(layout: Any, context: Any, settings: Any) -> None:
    """Buttons that bring a shown avatar to life, and what the last video has come to."""
    _draw_unseen(layout, context, settings.splats)
    layout.label(text="Orbit the avatar, or try", icon="INFO")
    column = layout.column(align=True)
    is_playing = context.screen.is_animation_playing
    text, icon = ("Pause", "PAUSE") if is_playing else ("Play  (Space)", "PLAY")
    column.operator("screen.animation_play", text=text, icon=icon)
    rig = rig_or_none(settings.head)
    if rig is not None:
        posing = is_posing(context, rig)
        text = "Done Posing" if posing else "Pose the Head"
        column.operator("stga.pose_head", text=text, icon="ARMATURE_DATA", depress=posing)
        if posing:
            mouth = settings.head.data.shape_keys.key_blocks.get("jawOpen")
            if mouth is not None:
                column.prop(mouth, "value", text="Open Mouth", slider=True)
            column.operator("stga.mirror_pose", icon="MOD_MIRROR")
            hint = "R turns the selected bone; I keeps the pose as a keyframe"
            draw_text(column, context, hint, "INFO")
    if is_head(settings.head) and has_selection(settings.head):
        with suppress(StgaError):  # splats without the node tree
            # grays out what the current frame's selection freezes
            toggle = {"icon": "RESTRICT_SELECT_OFF", "toggle": True}
            modifier = splat_modifier(settings.splats)
            draw_input(column, modifier, splat_nodes.SHOW_SELECTION, **toggle)
    draw_left_out(column, context)
    if draw_running(column, context, Kind.VIDEO):
        return
    video = monitor.state_of(context.scene, Kind.VIDEO)
    if video.subject is None:
        column.operator("stga.render_video", text="Render Video…", icon="RENDER_ANIMATION")
        return
    box = draw_end(column, context, video)
    if video.snapshot.state == WorkerState.FINISHED:
        opened = box.operator("wm.path_open", text=f"Open {video.subject.name}", icon="PLAY")
        opened.filepath = str(video.subject)
        draw_text(box, context, str(video.subject.parent), "FILE_FOLDER")


def _draw_unseen(layout: Any, context: Any, splats: Any) -> None:
    """What the color of sides that were not filmed means, while it is shown."""
    if not is_partly_observed(splats) or not get_input(splats, splat_nodes.SHOW_UNSEEN):
        return
    box = layout.box()
    draw_text(
        box, context, f"{splats[tags.OBSERVED].partition(';')[0].capitalize()}. {FILM_MORE}", "INFO"
    )
    draw_input(box, splat_modifier(splats), splat_nodes.SHOW_UNSEEN, toggle=True, icon="HIDE_OFF")
