"""The effects below the Train step: what the analysis of the capture decided, and why."""

from typing import Any, ClassVar

import bpy

from ..operators import ids
from ..operators.common import scene_settings
from ..stga_addon.jobs.table import Kind
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
        box = self.layout.column(align=True)
        split = box.split(factor=0.6)
        split.label(
            text=row.name.replace("-", " ").capitalize(), icon="CHECKMARK" if row.on else "REMOVE"
        )
        split.prop(row, "choice", text="")
        reasons = box.column(align=True)
        reasons.active = False
        for text in (row.reason, f"Cost: {row.cost}" if row.on else ""):
            draw_text(reasons, context, text, "BLANK1")
