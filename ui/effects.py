"""The effects below the Train step: what the analysis of the capture decided, and why."""

from typing import Any, ClassVar

import bpy

from ..operators import ids
from ..operators.common import scene_settings
from ..stga_addon.jobs.table import Kind
from ..stga_addon.training.effect_catalog import EFFECTS
from .request import draw_running
from .sidebar import SidebarPanel
from .text import draw_text


class EffectsPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_effects"
    bl_label = "Effects"
    bl_parent_id = "STGA_PT_train"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        if not draw_running(layout, context, Kind.ANALYSIS):
            layout.operator(ids.ANALYZE_CAPTURE, icon="VIEWZOOM")
        for row in settings.effects:
            self._draw_effect(context, row)

    def _draw_effect(self, context: Any, row: Any) -> None:
        effect, box = EFFECTS[row.name], self.layout.column(align=True)
        line = box.row(align=True)
        arrow = "DISCLOSURE_TRI_DOWN" if row.is_open else "DISCLOSURE_TRI_RIGHT"
        line.prop(row, "is_open", text="", icon=arrow, emboss=False)
        line.label(text=effect.title, icon="CHECKMARK" if row.on else "REMOVE")
        price = line.row()
        price.active, price.alignment = row.on, "RIGHT"
        price.label(text=effect.price)
        if row.is_open:
            box.row().prop(row, "choice", expand=True)
            for text in (f"{row.name}: {row.reason}", f"Cost: {row.cost}"):
                draw_text(box, context, text, "BLANK1")
