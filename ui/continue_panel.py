"""Below the Train step: refining a region of the trained avatar, and extending it by a further take."""

from typing import Any, ClassVar

import bpy

from ..operators import ids
from ..operators.common import is_head, scene_settings
from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.scene.display.heat_map import shows_residuals
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
    column, head = layout.column(), settings.head
    shown = shows_residuals(head)
    residuals = column.operator(
        ids.HEAT_MAP, text="Hide Residuals" if shown else "Show Residuals", icon="BRUSHES_ALL", depress=shown
    )
    residuals.show, residuals.of, residuals.directory = not shown, "RESIDUAL", settings.run_folder
    editing = head.mode == "EDIT"
    if not editing:
        column.prop_search(settings, "refine_group", head, "vertex_groups", text="Region")
    row = column.row(align=True)
    row.prop(settings, "refine_all_frames", text="All Frames", toggle=True)
    frames = row.row(align=True)
    frames.active = not settings.refine_all_frames
    frames.prop(settings, "refine_first", text="")
    frames.prop(settings, "refine_last", text="")
    row = column.row(align=True)
    row.prop(settings, "refine_seconds", text="Seconds")
    row.prop(settings, "refine_growth", text="More Splats")
    refine = column.operator(
        ids.REFINE, text="Refine Selected Faces" if editing else "Refine Vertex Group", icon="SCULPTMODE_HLT"
    )
    refine.directory, refine.device, refine.group = settings.run_folder, settings.device, settings.refine_group
    refine.adapter = settings.adapter
    refine.seconds, refine.growth = settings.refine_seconds, settings.refine_growth
    if not settings.refine_all_frames:
        refine.first, refine.last = settings.refine_first, max(settings.refine_first, settings.refine_last)


def _draw_extend(layout: Any, context: Any, settings: Any) -> None:
    column = layout.column()
    column.prop(settings, "take", text="Take")
    column.prop(settings, "extend_seconds", text="Seconds")
    extend = column.operator(ids.EXTEND, icon="ADD")
    extend.directory, extend.device, extend.take = settings.run_folder, settings.device, settings.take
    extend.adapter, extend.seconds = settings.adapter, settings.extend_seconds
    if not draw_running(column, context, Kind.SELECTION):
        column.operator(ids.SELECT_EXTENSION, icon="GROUP_VERTEX").directory = settings.run_folder
