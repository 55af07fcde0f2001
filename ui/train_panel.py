"""The Train step: settings, progress, and result or failure."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..operators import ids, monitor
from ..operators.analyze import chosen_effects
from ..operators.common import is_head, package, scene_settings
from ..operators.train import TrainOptions
from ..operators.training_python import has_training_python
from ..stga_addon.format import describe_figures, format_duration
from ..stga_addon.jobs.monitor_state import RequestState
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.training.run.folder import TRACKING
from ..stga_addon.worker.status import WorkerState
from .curve import draw_curve
from .options import set_options
from .properties import preset_times
from .request import draw_end, draw_running
from .sidebar import SidebarPanel
from .text import draw_text


class TrainPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_train"
    bl_label = "3 Train"

    def draw(self, context: Any) -> None:
        if draw_running(self.layout, context, Kind.TRAINING):
            return
        training = monitor.state_of(context.scene, Kind.TRAINING)
        if training.subject is not None:
            _draw_end(self.layout, context, training)
        _draw_choices(self.layout, context)


def _draw_choices(layout: Any, context: Any) -> None:
    settings = scene_settings(context)
    layout.prop(settings, "run_folder", text="Folder")
    layout.prop(settings, "preset")
    times = ", ".join(
        f"{name} {format_duration(seconds)}" for name, seconds in preset_times(settings).items()
    )
    if times:
        draw_text(layout, context, f"On this machine: {times}", "TIME")
    layout.prop(settings, "minutes")
    row = layout.row(align=True)
    draw_train_button(row, settings)
    draw_train_button(row, settings, resume=True)
    draw_missing_python(layout, context)


def draw_train_button(layout: Any, settings: Any, resume: bool = False) -> None:
    """Draw the button that starts, or resumes, training with the panel's settings."""
    train = layout.operator(
        ids.TRAIN,
        text="Resume" if resume else "Train",
        icon="FRAME_NEXT" if resume else "MOD_PARTICLES",
    )
    set_options(train, settings, TrainOptions)
    train.directory, train.resume = settings.run_folder, resume
    train.effects = " ".join(chosen_effects(settings))


def draw_missing_python(layout: Any, context: Any) -> None:
    """Where no Python here can track and train, say where one is chosen."""
    if not has_training_python(context):
        show = layout.operator("preferences.addon_show", text="Choose a Python", icon="PREFERENCES")
        show.module = package()


class TrainOptionsPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_train_options"
    bl_label = "Options"
    bl_parent_id = TrainPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        settings = scene_settings(context)
        names = ["strategy", "device", "show_result", "live_preview"]
        if settings.device == "gpu":
            names.insert(2, "adapter")
        for name in names:
            self.layout.prop(settings, name)


def _draw_end(layout: Any, context: Any, training: RequestState) -> None:
    box, state = draw_end(layout, context, training), training.snapshot.state
    if state == WorkerState.NONE:
        draw_text(
            box,
            context,
            f"{training.place}: does not exist; choose its new folder and press Resume",
        )
    elif not state.failed:
        for line in describe_figures(training.snapshot.status.figures)[1:]:
            draw_text(box, context, line)
        draw_curve(box, training.place)
        if training.files.tracking is not None:
            _draw_refined(box, context, training.place / TRACKING)


def _draw_refined(layout: Any, context: Any, path: Path) -> None:
    """Draw a button that exchanges the imported tracking for the refined one, which the splats were
    trained with."""
    head = scene_settings(context).head
    apply = layout.operator(ids.APPLY_MOTION, text="Apply Refined Tracking", icon="CON_FOLLOWTRACK")
    apply.filepath, apply.own_offsets = str(path), True
    apply.start = head[tags.TIMESTEPS][0] if is_head(head) else 1
