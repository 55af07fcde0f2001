"""What the panels of the sidebar tab share: their base, wrapped text, options of buttons, and how a
request is drawn: progress with Cancel, end with Dismiss, failure with the end of the log."""

import re
import textwrap
from pathlib import Path
from typing import Any

import bpy.utils.previews
import numpy as np

from ..operators import monitor
from ..operators.common import TAB, AtEnd
from ..stga_addon.format import describe_figures, describe_left, describe_quality
from ..stga_addon.jobs.monitor_state import RequestState
from ..stga_addon.jobs.table import KINDS, STORED, Kind
from ..stga_addon.scene.tags import is_head
from ..stga_addon.worker.status import WorkerState, WorkerStatus

LETTER_WIDTH_PX = 7
"""Average, at a resolution scale of 1."""
WAITING = "Done; shown as soon as Edit Mode or rendering ends"
"""Message on a finished job whose result is not shown yet."""
SCALE = 8.0
"""Side of the picture in the panel, in heights of a button."""

_previews: Any = None
"""Blender's preview collection: pictures that are not saved in the .blend file."""
_drawn: dict[str, np.ndarray] = {}
"""Name of a preview -> the picture that it shows."""


class SidebarPanel:
    """Mixin of panels: the identifier of `TrainPanel` is "STGA_PT_train"."""

    bl_idname: str
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = TAB

    def __init_subclass__(cls) -> None:
        words = re.findall("[A-Z][a-z]*", cls.__name__.removesuffix("Panel"))
        cls.bl_idname = f"STGA_PT_{'_'.join(words).lower()}"


class ClosedPanel(SidebarPanel):
    bl_options = frozenset({"DEFAULT_CLOSED"})


class HeadPanel(ClosedPanel):
    """What is about a head, and is not shown without one."""

    @classmethod
    def poll(cls, context: Any) -> bool:
        return is_head(context.scene.stga.head)


def draw_text(layout: Any, context: Any, text: str, icon: str = "NONE") -> None:
    """Draw the text as a label for each line, because Blender truncates; the icon at the first."""
    column = layout.column(align=True)
    lines = textwrap.wrap(
        text, columns(context, context.region.width) - (3 if icon != "NONE" else 0)
    )
    for row, line in enumerate(lines):
        column.label(text=line, icon=icon if row == 0 or icon == "NONE" else "BLANK1")


def columns(context: Any, width_px: int) -> int:
    """Number of letters that fit into a label of a panel, or menu, so wide."""
    letter_px = LETTER_WIDTH_PX * context.preferences.system.ui_scale
    return max(20, int(width_px / letter_px) - 4)


def set_options(button: Any, settings: Any, options: type) -> None:
    """Give an operator's button the settings' values of the properties in the class `options`."""
    for base in options.__mro__[:-1]:
        for name in base.__annotations__:
            setattr(button, name, getattr(settings, name))


# Requests


def draw_running(layout: Any, context: Any, kind: Kind) -> bool:
    """Draw the progress of the scene's request with its Cancel button; False where none runs."""
    state = monitor.state_of(context.scene, kind)
    if state.error:
        draw_text(layout, context, state.error, "ERROR")
    if not state.is_running:
        return False
    now = state.snapshot
    percent = 100 * state.snapshot.status.progress
    text = WAITING
    if now.state in (WorkerState.STARTING, WorkerState.CANCELLING):
        text = now.state.value.capitalize()
    elif now.state.is_alive:
        text = now.status.message
    layout.progress(factor=now.status.progress, text=f"{percent:.0f} %  {text}")
    draw_text(layout, context, describe_left(now.status.figures), "TIME")
    draw_figures(layout, context, now.status)
    if kind in STORED:
        draw_curve(layout, state.run)
    layout.operator("stga.cancel", text="Cancel", icon="CANCEL").request = kind
    return True


def draw_arrow(layout: Any, owner: Any, name: str, text: str) -> bool:
    """Draw what unfolds the rows below it; whether they are to be drawn."""
    is_open: bool = getattr(owner, name)
    row = layout.row()
    row.alignment = "LEFT"
    arrow = "DISCLOSURE_TRI_DOWN" if is_open else "DISCLOSURE_TRI_RIGHT"
    row.prop(owner, name, text=text, icon=arrow, emboss=False)
    return is_open


def draw_figures(layout: Any, context: Any, status: WorkerStatus) -> None:
    """Draw a word for how good the result is; figures, and what more time brings, unfold."""
    lines = describe_figures(status.figures)
    word = describe_quality(status.figures)
    column = layout.column(align=True)
    if not lines:
        draw_text(column, context, status.detail)
        return
    text = f"Quality: {word}" if word else "Figures"
    is_open = draw_arrow(column, context.scene.stga, "show_figures", text)
    for line in (*lines, status.detail) if is_open else ():
        draw_text(column, context, line)


def draw_end(layout: Any, context: Any, state: RequestState) -> Any:
    """Draw how a request has ended, its failure with the end of the log and a button that copies
    the report, and its Dismiss button; returns the box, for more."""
    box = layout.box()
    now = state.snapshot
    worker = WorkerState.FAILED if now.state.failed else now.state
    row = box.row()
    icons = {WorkerState.FINISHED: "CHECKMARK", WorkerState.CANCELLED: "INFO"}
    ends = (WorkerState.FINISHED, WorkerState.CANCELLED, WorkerState.FAILED, WorkerState.NONE)
    texts = dict(zip(ends, KINDS[state.kind].ends, strict=True))
    row.label(text=texts.get(worker, ""), icon=icons.get(worker, "ERROR"))
    if state.can_be_dismissed:
        row.operator("stga.dismiss", text="", icon="X", emboss=False).request = state.kind
    if now.state.failed:
        draw_text(box, context, now.status.error)
        width = columns(context, context.region.width)
        log = box.column(align=True)
        log.active = False
        for line in now.log_tail:
            short = textwrap.shorten(line, width, placeholder="…")
            log.label(text=short if len(line) > width else line)
        box.operator("stga.copy_report", icon="COPYDOWN").directory = str(state.folder)
    if state.loading is not None:
        draw_text(box, context, WAITING, "INFO")
    return box


def draw_curve(layout: Any, folder: Path) -> None:
    """Draw the curve of the run in this folder, or the head over the footage that is tracked;
    nothing before then."""
    curve = monitor.curves.get(folder)
    if curve is None:
        return
    pixels, *texts = curve
    column = layout.column(align=True)
    draw_picture(column, str(folder), pixels)
    for text in filter(None, texts):
        column.label(text=text)


def draw_picture(layout: Any, name: str, pixels: np.ndarray) -> None:
    """Draw a picture (H, W, 4) float32, from the bottom up; the same array costs nothing again."""
    if _drawn.get(name) is not pixels:
        _drawn[name] = pixels
        _previews.pop(name, None)  # a new one, because Blender keeps the texture of the old one
        preview = _previews.new(name)
        preview.image_size = pixels.shape[1], pixels.shape[0]
        preview.image_pixels_float.foreach_set(np.ascontiguousarray(pixels).ravel())
    layout.template_icon(_previews[name].icon_id, scale=SCALE)


def register(at_end: AtEnd) -> None:
    global _previews
    _previews = bpy.utils.previews.new()
    at_end(bpy.utils.previews.remove, _previews)
    at_end(_drawn.clear)
