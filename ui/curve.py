"""A run's curve as a picture in the panel: read from the run's folder whenever an evaluation was added to it."""

from pathlib import Path
from typing import Any

import bpy.utils.previews
import numpy as np

from ..stga_addon.errors import StgaError
from ..stga_addon.report.curve_image import SIZE, curve_image
from ..stga_addon.training.run.metrics_log import METRICS, read_metrics

SCALE = 8.0
"""Side of the picture in the panel, in heights of a button."""

_pictures: Any = None
"""Previews, which are in no .blend file."""
_drawn: dict[Path, tuple[tuple[int, int], str | None]] = {}
"""Run folder -> size and time of its evaluations as they were last drawn, and what the axes say; None: too few."""


def draw_curve(layout: Any, run: Path) -> None:
    """Draw nothing where the run has not been evaluated twice."""
    axes = _update(run)
    if axes is None:
        return
    column = layout.column(align=True)
    column.template_icon(_pictures[str(run)].icon_id, scale=SCALE)
    column.label(text=axes)


def _update(run: Path) -> str | None:
    try:
        found = (run / METRICS).stat()
    except OSError:
        return None
    stamp = found.st_mtime_ns, found.st_size
    if run not in _drawn or _drawn[run][0] != stamp:
        _drawn[run] = stamp, _paint(run)
    return _drawn[run][1]


def _paint(run: Path) -> str | None:
    try:
        drawn = curve_image(read_metrics(run))
    except (StgaError, KeyError, TypeError, ValueError):
        return None  # a damaged file is training's to report
    if drawn is None:
        return None
    pixels, axes = drawn
    _pictures.pop(str(run), None)  # a new one: Blender keeps what it once uploaded
    picture = _pictures.new(str(run))
    picture.image_size = SIZE, SIZE
    picture.image_pixels_float.foreach_set(np.ascontiguousarray(pixels).ravel())
    return axes


def register() -> None:
    global _pictures
    _pictures = bpy.utils.previews.new()


def unregister() -> None:
    bpy.utils.previews.remove(_pictures)
    _drawn.clear()
