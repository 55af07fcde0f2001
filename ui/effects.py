"""The plan below the Train step: each effect, what was decided, and why."""

import textwrap
from typing import Any, ClassVar

import bpy

from ..operators import ids
from ..operators.common import settings
from ..operators.plan import is_looking
from .step import Step

COLUMNS = 44
"""Letters in a line of a sidebar of usual width."""


class EffectsPanel(Step, bpy.types.Panel):
    bl_idname = "STGA_PT_effects"
    bl_label = "Effects"
    bl_parent_id = "STGA_PT_train"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        layout, chosen = self.layout, settings(context)
        looking = is_looking(context.scene)
        layout.operator(ids.PLAN_EFFECTS, text="Looking…" if looking else "Look at Capture", icon="VIEWZOOM")
        for line in textwrap.wrap(chosen.plan_error, COLUMNS):
            layout.label(text=line, icon="ERROR" if chosen.plan_error.startswith(line) else "BLANK1")
        for row in chosen.effects:
            self._draw_effect(row)

    def _draw_effect(self, row: Any) -> None:
        box = self.layout.column(align=True)
        split = box.split(factor=0.6)
        split.label(text=row.name, icon="CHECKBOX_HLT" if row.on else "CHECKBOX_DEHLT")
        split.prop(row, "choice", text="")
        for text in (row.reason, f"costs {row.cost}" if row.on else ""):
            for line in textwrap.wrap(text, COLUMNS):
                box.label(text=line, icon="BLANK1")
