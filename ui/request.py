"""A request in a panel: its progress with Cancel, its end with Dismiss, and its failure with the
end of the log."""

import textwrap
from typing import Any

from ..operators import ids, monitor
from ..stga_addon.format import describe_figures
from ..stga_addon.jobs.monitor_state import RequestState
from ..stga_addon.jobs.table import KINDS, STORED, Kind
from ..stga_addon.worker.status import WorkerState
from .curve import draw_curve
from .text import columns, draw_text

WAITING = "Done; shown as soon as Edit Mode or rendering ends"


def draw_running(layout: Any, context: Any, kind: Kind) -> bool:
    """Draw the progress of the scene's request with its Cancel button; returns False where none is
    running."""
    state = monitor.state_of(context.scene, kind)
    if state.error:
        draw_text(layout, context, state.error, "ERROR")
    if not state.is_running:
        return False
    now = state.snapshot
    text = {WorkerState.STARTING: "Starting", WorkerState.CANCELLING: "Cancelling"}.get(
        now.state, now.status.message
    )
    text = text if now.state.is_alive else WAITING
    layout.progress(factor=now.status.progress, text=f"{100 * now.status.progress:.0f} %  {text}")
    column = layout.column(align=True)
    for line in (*describe_figures(now.status.figures), now.status.detail):
        draw_text(column, context, line)
    if kind in STORED:
        draw_curve(layout, state.run)
    layout.operator(ids.CANCEL, text="Cancel", icon="CANCEL").request = kind
    return True


def draw_end(layout: Any, context: Any, state: RequestState) -> Any:
    """Draw how a request has ended, its failure, and its Dismiss button; returns the box, for
    more."""
    box, worker = layout.box(), state.snapshot.state
    row = box.row()
    icons = {WorkerState.FINISHED: "CHECKMARK", WorkerState.CANCELLED: "INFO"}
    ends = (WorkerState.FINISHED, WorkerState.CANCELLED, WorkerState.FAILED, WorkerState.NONE)
    texts = dict(zip(ends, KINDS[state.kind].ends, strict=True))
    text = texts.get(WorkerState.FAILED if worker.failed else worker, "")
    row.label(text=text, icon=icons.get(worker, "ERROR"))
    if state.can_be_dismissed:
        row.operator(ids.DISMISS, text="", icon="X", emboss=False).request = state.kind
    if worker.failed:
        draw_failure(box, context, state)
    if state.loading is not None:
        draw_text(box, context, WAITING, "INFO")
    return box


def draw_failure(layout: Any, context: Any, state: RequestState) -> None:
    """Draw the worker's error message, the end of its log, and a button that copies the report."""
    now = state.snapshot
    draw_text(layout, context, now.status.error)
    width = columns(context)
    log = layout.column(align=True)
    log.active = False
    for line in now.log_tail:
        log.label(
            text=textwrap.shorten(line, width, placeholder="…") if len(line) > width else line
        )
    layout.operator(ids.COPY_REPORT, icon="COPYDOWN").directory = str(state.folder)
