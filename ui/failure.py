"""A worker's failure: its error message, the end of its log, and a button that copies the report."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..operators import ids
from .text import columns, draw_text


def draw_failure(layout: Any, context: Any, sentence: str, tail: Sequence[str], folder: Path | None) -> None:
    """Draw the error message and the log's last lines. folder: the worker's status folder; None: nothing to report."""
    draw_text(layout, context, sentence)
    width = columns(context)
    log = layout.column(align=True)
    log.active = False
    for line in tail:
        log.label(text=textwrap.shorten(line, width, placeholder="…") if len(line) > width else line)
    if folder is not None:
        layout.operator(ids.COPY_REPORT, icon="COPYDOWN").directory = str(folder)
