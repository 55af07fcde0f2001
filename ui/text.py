"""Text in a panel: Blender cuts labels off instead of wrapping them."""

import textwrap
from typing import Any

LETTER = 7
"""Pixels of a letter of usual width, at a resolution scale of 1."""


def columns(context: Any) -> int:
    """Letters that a label of the panel's region has room for."""
    return max(20, int(context.region.width / (LETTER * context.preferences.system.ui_scale)) - 4)


def draw_text(layout: Any, context: Any, text: str, icon: str = "NONE") -> None:
    """A label of as many lines as the text takes; the icon stands before the first."""
    column = layout.column(align=True)
    lines = textwrap.wrap(text, columns(context) - (3 if icon != "NONE" else 0))
    for row, line in enumerate(lines):
        column.label(text=line, icon=icon if row == 0 or icon == "NONE" else "BLANK1")
