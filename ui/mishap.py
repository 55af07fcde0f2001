"""A worker's mishap: one sentence, the end of its log, and a way to copy all of it."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..operators import ids


def draw_mishap(layout: Any, context: Any, sentence: str, tail: Sequence[str], folder: Path | None) -> None:
    """Draw the sentence, wrapped, and below it the log's last lines; `folder` is the worker's, None without one."""
    # Blender does not wrap labels; a character is about seven pixels wide.
    width = max(20, int(context.region.width / (7 * context.preferences.system.ui_scale)) - 4)
    column = layout.column(align=True)
    for line in textwrap.wrap(sentence, width):
        column.label(text=line)
    log = layout.column(align=True)
    log.active = False
    for line in tail:
        log.label(text=textwrap.shorten(line, width, placeholder="…") if len(line) > width else line)
    if folder is not None:
        layout.operator(ids.COPY_REPORT, icon="COPYDOWN").directory = str(folder)
