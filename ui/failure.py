"""A worker's mishap: one sentence, the end of its log, and a way to copy all of it."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..operators import ids
from .text import columns, draw_text


def draw_failure(layout: Any, context: Any, sentence: str, tail: Sequence[str], folder: Path | None) -> None:
    """Draw the sentence, wrapped, and below it the log's last lines; `folder` is the worker's, None without one."""
    draw_text(layout, context, sentence)
    width = columns(context)
    log = layout.column(align=True)
    log.active = False
    for line in tail:
        log.label(text=textwrap.shorten(line, width, placeholder="…") if len(line) > width else line)
    if folder is not None:
        layout.operator(ids.COPY_REPORT, icon="COPYDOWN").directory = str(folder)
