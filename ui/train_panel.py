"""The Train step: what to train, how far it is, and what went wrong."""

from pathlib import Path
from typing import Any

import bpy

from ..operators import ids, monitor
from ..operators.analyze import chosen_effects
from ..operators.common import package, scene_settings
from ..operators.environment import has_training_python
from ..stga_addon.format import format_duration
from ..stga_addon.jobs.training_job import job_folder
from ..stga_addon.scene import tags
from ..stga_addon.training.effect_plan import TRACKING
from ..stga_addon.training.run.progress import describe_figures
from ..stga_addon.worker.status import WorkerSnapshot, WorkerState
from .curve import draw_curve
from .failure import draw_failure
from .properties import seconds_of_presets
from .sidebar import SidebarPanel
from .text import draw_text


class TrainPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_train"
    bl_label = "3 Train"

    def draw(self, context: Any) -> None:
        run = monitor.run_of(context.scene)
        now = monitor.snapshot_of(context.scene)
        if now.state.is_alive:
            _draw_progress(self.layout, context, run, now)
            return
        if run is not None:
            _draw_end(self.layout, context, run, now)
        _draw_choices(self.layout, context)


def _draw_choices(layout: Any, context: Any) -> None:
    chosen = scene_settings(context)
    layout.prop(chosen, "run_folder", text="Folder")
    layout.prop(chosen, "preset")
    times = ", ".join(f"{name} {format_duration(seconds)}" for name, seconds in seconds_of_presets(chosen).items())
    if times:
        draw_text(layout, context, f"On this machine: {times}", "TIME")
    layout.prop(chosen, "minutes")
    layout.prop(chosen, "strategy")
    layout.prop(chosen, "show_result")
    row = layout.row(align=True)
    for resume, text, icon in ((False, "Train", "PLAY"), (True, "Resume", "FRAME_NEXT")):
        train = row.operator(ids.TRAIN, text=text, icon=icon)
        train.directory, train.minutes, train.resume = chosen.run_folder, chosen.minutes, resume
        train.strategy, train.preset = chosen.strategy, chosen.preset
        train.effects = " ".join(chosen_effects(chosen))
    if not has_training_python(context):
        layout.label(text="No training environment yet", icon="INFO")
        layout.operator("preferences.addon_show", text="Set Up in Preferences").module = package()


def _draw_progress(layout: Any, context: Any, run: Path, now: WorkerSnapshot) -> None:
    status = now.status
    text = {WorkerState.STARTING: "starting", WorkerState.CANCELLING: "cancelling"}.get(now.state, status.message)
    layout.progress(factor=status.progress, text=f"{100 * status.progress:.0f} %  {text}")
    column = layout.column(align=True)
    for line in (*describe_figures(status.figures), status.detail):
        draw_text(column, context, line)
    draw_curve(layout, run)
    layout.prop(scene_settings(context), "live_preview")
    layout.prop(scene_settings(context), "show_result")
    layout.operator(ids.CANCEL_TRAINING, text="Cancel", icon="CANCEL")


def _draw_end(layout: Any, context: Any, run: Path, now: WorkerSnapshot) -> None:
    box = layout.box()
    row = box.row()
    if now.state == WorkerState.NONE:
        row.label(text="The run is gone", icon="ERROR")
        draw_failure(box, context, f"{run}: is not there; was it moved? Choose its folder and press Resume", (), None)
    elif now.state.failed:
        row.label(text="Training failed", icon="ERROR")
        draw_failure(box, context, now.status.error, now.log_tail, job_folder(run))
    else:
        done = {WorkerState.FINISHED: "Trained", WorkerState.CANCELLED: "Cancelled, avatar kept"}[now.state]
        row.label(text=done, icon="CHECKMARK")
        for line in describe_figures(now.status.figures)[1:]:
            draw_text(box, context, line)
        draw_curve(box, run)
        if (run / TRACKING).is_file():
            _draw_refined(box, context, run / TRACKING)
    row.operator(ids.DISMISS_TRAINING, text="", icon="X", emboss=False)


def _draw_refined(layout: Any, context: Any, path: Path) -> None:
    """The splats were trained on other meshes than the imported ones, which a click exchanges."""
    head = scene_settings(context).head
    column = layout.column()
    column.operator_context = "EXEC_DEFAULT"  # without a file dialog
    column.enabled = head is not None
    apply = column.operator(ids.APPLY_MOTION, text="Apply Refined Tracking", icon="CON_FOLLOWTRACK")
    apply.filepath, apply.source, apply.own_offsets = str(path), "", True
    apply.start = head[tags.TIMESTEPS][0] if head is not None else 1
