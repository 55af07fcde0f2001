"""Below the Train step: refining a region of the trained avatar, and extending it by a further
take."""

from typing import Any, ClassVar

import bpy

from ..operators import ids
from ..operators.common import is_head, scene_settings
from ..operators.continue_run import ExtendOptions, RefineOptions
from ..operators.train import DeviceOptions
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene.vertex_groups import shows_residuals
from .options import set_options
from .request import draw_running
from .sidebar import SidebarPanel
from .train_panel import TrainPanel


class ContinuePanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_continue"
    bl_label = "Refine and Extend"
    bl_parent_id = TrainPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return is_head(scene_settings(context).head)

    def draw(self, context: Any) -> None:
        settings = scene_settings(context)
        _draw_refine(self.layout, settings)
        _draw_extend(self.layout, context, settings)


def _draw_refine(layout: Any, settings: Any) -> None:
    column, head, options = layout.column(), settings.head, settings.refine
    shown = shows_residuals(head)
    residuals = column.operator(
        ids.HEAT_MAP,
        text="Hide Residuals" if shown else "Show Residuals",
        icon="BRUSHES_ALL",
        depress=shown,
    )
    residuals.show, residuals.of, residuals.directory = not shown, "RESIDUAL", settings.run_folder
    editing = head.mode == "EDIT"
    if not editing:
        column.prop_search(options, "group", head, "vertex_groups", text="Region")
    row = column.row(align=True)
    row.prop(options, "all_frames", toggle=True)
    frames = row.row(align=True)
    frames.active = not options.all_frames
    frames.prop(options, "first", text="")
    frames.prop(options, "last", text="")
    fields = column.column(align=True)
    fields.prop(options, "seconds")
    fields.prop(options, "growth")
    refine = column.operator(
        ids.REFINE,
        text="Refine Selected Faces" if editing else "Refine Vertex Group",
        icon="SCULPTMODE_HLT",
    )
    set_options(refine, settings, DeviceOptions)
    set_options(refine, options, RefineOptions)
    refine.directory = settings.run_folder
    if not options.all_frames:
        refine.first, refine.last = options.first, max(options.first, options.last)


def _draw_extend(layout: Any, context: Any, settings: Any) -> None:
    column = layout.column()
    column.prop(settings.extend, "take")
    column.prop(settings.extend, "seconds")
    extend = column.operator(ids.EXTEND, icon="ADD")
    set_options(extend, settings, DeviceOptions)
    set_options(extend, settings.extend, ExtendOptions)
    extend.directory = settings.run_folder
    if not draw_running(column, context, Kind.SELECTION):
        column.operator(ids.SELECT_EXTENSION, icon="GROUP_VERTEX").directory = settings.run_folder
