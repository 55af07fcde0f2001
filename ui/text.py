"""Wrapped text in a panel: Blender truncates labels instead of wrapping them."""

import textwrap
from typing import Any

LETTER_WIDTH_PX = 7
"""Average, at a resolution scale of 1."""


def columns(context: Any) -> int:
    """Number of letters that fit into a label of the panel's region."""
    return max(
        20, int(context.region.width / (LETTER_WIDTH_PX * context.preferences.system.ui_scale)) - 4
    )


def draw_text(layout: Any, context: Any, text: str, icon: str = "NONE") -> None:
    """Draw the text as labels, one for each line; the icon before the first."""
    column = layout.column(align=True)
    lines = textwrap.wrap(text, columns(context) - (3 if icon != "NONE" else 0))
    for row, line in enumerate(lines):
        column.label(text=line, icon=icon if row == 0 or icon == "NONE" else "BLANK1")
