"""The Train step: settings, progress, and result or failure; refining a region of the trained
avatar, and extending it by a further take; what the analysis decided about effects, and why."""

from pathlib import Path
from typing import Any

import bpy

from ..operators import monitor, train
from ..operators.common import package
from ..operators.training_python import has_training_python
from ..stga_addon.capture.repairs import REPAIR_OPTION
from ..stga_addon.format import format_duration
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.scene.tags import is_head
from ..stga_addon.scene.vertex_groups import shows_residuals
from ..stga_addon.training.effect_catalog import EFFECTS
from ..stga_addon.training.run.folder import TRACKING
from ..stga_addon.worker.status import WorkerState
from .properties import preset_times
from .sidebar import (
    ClosedPanel,
    HeadPanel,
    SidebarPanel,
    draw_curve,
    draw_end,
    draw_figures,
    draw_running,
    draw_text,
    set_options,
)


class TrainPanel(SidebarPanel, bpy.types.Panel):
    bl_label = "3 Train"

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = context.scene.stga
        owner = settings.training_head
        is_of_another = owner is not None and owner != settings.head
        if is_of_another:
            layout.label(text=owner.name, icon="USER")
        if draw_running(layout, context, Kind.TRAINING):
            return
        training = monitor.state_of(context.scene, Kind.TRAINING)
        if training.subject is not None:
            box = draw_end(layout, context, training)
            run = training.place
            state = training.snapshot.state
            if state == WorkerState.NONE:
                remedy = "choose its new folder and press Resume"
                draw_text(box, context, f"{run}: does not exist; {remedy}")
            elif REPAIR_OPTION in training.snapshot.status.error:
                draw_repair(box)
            elif not state.failed:
                draw_figures(box, context, training.snapshot.status)
                draw_curve(box, run)
                if training.files.tracking is not None:  # the splats were trained with it
                    head = context.scene.stga.head
                    text = "Apply Refined Tracking"
                    apply = box.operator("stga.apply_motion", text=text, icon="CON_FOLLOWTRACK")
                    apply.filepath = str(run / TRACKING)
                    apply.own_offsets = True
                    apply.start = head[tags.TIMESTEPS][0] if is_head(head) else 1
        layout.prop(settings, "run_folder", text="Folder")
        layout.prop(settings, "preset")
        times = [f"{name} {format_duration(s)}" for name, s in preset_times(settings).items()]
        if times:
            draw_text(layout, context, f"On this machine: {', '.join(times)}", "TIME")
        layout.prop(settings, "minutes")
        row = layout.row(align=True)
        draw_train_button(row, settings)
        folder = Path(bpy.path.abspath(settings.run_folder))
        is_known = training.subject is not None and training.place == folder
        is_known &= not is_of_another
        if is_known or settings.holds_run:
            finished = training.snapshot.state == WorkerState.FINISHED
            is_more = finished if is_known else bool(settings.avatar)
            draw_train_button(row, settings, goes_on="more" if is_more else "resume")
        draw_missing_python(layout, context)


def draw_train_button(layout: Any, settings: Any, goes_on: str = "") -> None:
    """Draw the button that starts training with the panel's settings, or goes on with it: "resume"
    or "more"."""
    more = f"Train {format_duration(60 * settings.minutes)} More"
    text = {"": "Train", "resume": "Resume", "more": more}[goes_on]
    button = layout.operator(
        "stga.train", text=text, icon="FRAME_NEXT" if goes_on else "MOD_PARTICLES"
    )
    set_options(button, settings, train.TrainOptions)
    button.directory = settings.run_folder
    button.resume = goes_on == "resume"
    button.more = goes_on == "more"
    button.effects = " ".join(train.chosen_effects(settings))


def draw_repair(layout: Any) -> None:
    """Draw the button by which the capture is read as its mesh fits the images."""
    repair = layout.operator("stga.analyze_capture", text="Repair Capture", icon="TOOL_SETTINGS")
    repair.repair = True


def draw_missing_python(layout: Any, context: Any) -> None:
    """Where no Python here can track and train, say where one is chosen."""
    if not has_training_python(context):
        draw_preferences(layout, "Choose a Python")


def draw_preferences(layout: Any, text: str) -> None:
    """Draw a button that opens the add-on's preferences."""
    show = layout.operator("preferences.addon_show", text=text, icon="PREFERENCES")
    show.module = package()


class TrainOptionsPanel(ClosedPanel, bpy.types.Panel):
    bl_label = "Options"
    bl_parent_id = TrainPanel.bl_idname

    def draw(self, context: Any) -> None:
        settings = context.scene.stga
        for name in ("strategy", "device", "adapter", "show_result", "live_preview"):
            if name != "adapter" or settings.device == "gpu":
                self.layout.prop(settings, name)


class ContinuePanel(HeadPanel, bpy.types.Panel):
    bl_label = "Refine and Extend"
    bl_parent_id = TrainPanel.bl_idname

    def draw(self, context: Any) -> None:
        settings = context.scene.stga
        column = self.layout.column()
        head = settings.head
        options = settings.refine
        is_visible = shows_residuals(head)
        editing = head.mode == "EDIT"
        text = "Hide Residuals" if is_visible else "Show Residuals"
        residuals = column.operator(
            "stga.heat_map", text=text, icon="BRUSHES_ALL", depress=is_visible
        )
        residuals.show = not is_visible
        residuals.of = "RESIDUAL"
        if not editing:
            column.prop_search(options, "group", head, "vertex_groups", text="Region")
        column.prop(options, "all_frames", toggle=True)
        frames = column.row(align=True)
        frames.active = not options.all_frames
        frames.prop(options, "first", text="")
        frames.prop(options, "last", text="")
        fields = column.column(align=True)
        fields.prop(options, "seconds")
        fields.prop(options, "growth")
        text = "Refine Selected Faces" if editing else "Refine Vertex Group"
        refine = column.operator("stga.refine", text=text, icon="SCULPTMODE_HLT")
        set_options(refine, settings, train.DeviceOptions)
        set_options(refine, options, train.RefineOptions)
        refine.directory = residuals.directory = settings.run_folder
        if not options.all_frames:
            refine.first = options.first
            refine.last = max(options.first, options.last)
        column = self.layout.column()
        column.prop(settings.extend, "take")
        column.prop(settings.extend, "seconds")
        extend = column.operator("stga.extend", icon="ADD")
        set_options(extend, settings, train.DeviceOptions)
        set_options(extend, settings.extend, train.ExtendOptions)
        extend.directory = settings.run_folder


class EffectsPanel(ClosedPanel, bpy.types.Panel):
    bl_label = "Effects"
    bl_parent_id = TrainPanel.bl_idname

    def draw(self, context: Any) -> None:
        if not draw_running(self.layout, context, Kind.ANALYSIS):
            self.layout.operator("stga.analyze_capture", icon="VIEWZOOM")
            if context.scene.stga.misfit:
                draw_text(self.layout, context, context.scene.stga.misfit, "ERROR")
                draw_repair(self.layout)
        for row in context.scene.stga.effects:
            effect = EFFECTS[row.name]
            box = self.layout.column(align=True)
            line = box.row(align=True)
            arrow = "DISCLOSURE_TRI_DOWN" if row.is_open else "DISCLOSURE_TRI_RIGHT"
            line.prop(row, "is_open", text="", icon=arrow, emboss=False)
            line.label(text=effect.title, icon="CHECKMARK" if row.on else "REMOVE")
            price = line.row()
            price.active = row.on
            price.alignment = "RIGHT"
            price.label(text=effect.price)
            if row.is_open:
                box.row().prop(row, "choice", expand=True)
                for text in (f"{row.name}: {row.reason}", f"Cost: {row.cost}"):
                    draw_text(box, context, text, "BLANK1")
