"""The effects below the Train step: what the analysis of the capture decided, and why."""

from typing import Any, ClassVar

import bpy

from ..operators import background, ids
from ..operators.common import scene_settings
from .sidebar import SidebarPanel
from .text import draw_text


def draw_running(layout: Any, context: Any) -> bool:
    """Draw the command that runs for the scene, with its cancel button; returns False where none runs."""
    if not background.running(context.scene):
        return False
    row = layout.row(align=True)
    waits = background.is_waiting(context.scene)
    row.label(text="Done: leave Edit Mode" if waits else "Analyzing…", icon="INFO" if waits else "VIEWZOOM")
    row.operator(ids.CANCEL_ANALYSIS, text="", icon="CANCEL")
    return True


class EffectsPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_effects"
    bl_label = "Effects"
    bl_parent_id = "STGA_PT_train"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        if not draw_running(layout, context):
            layout.operator(ids.ANALYZE_CAPTURE, icon="VIEWZOOM")
        if settings.analysis_error:
            draw_text(layout, context, settings.analysis_error, "ERROR")
        for row in settings.effects:
            self._draw_effect(context, row)

    def _draw_effect(self, context: Any, row: Any) -> None:
        box = self.layout.column(align=True)
        split = box.split(factor=0.6)
        split.label(text=row.name.replace("-", " ").capitalize(), icon="CHECKMARK" if row.on else "REMOVE")
        split.prop(row, "choice", text="")
        reasons = box.column(align=True)
        reasons.active = False
        for text in (row.reason, f"Cost: {row.cost}" if row.on else ""):
            draw_text(reasons, context, text, "BLANK1")
