"""Picture of a run's accuracy curve, or of a tracking, in the panel."""

from pathlib import Path
from typing import Any

import bpy.utils.previews
import numpy as np

from ..operators import monitor

SCALE = 8.0
"""Side of the picture in the panel, in heights of a button."""

_previews: Any = None
"""Blender's preview collection: pictures that are not saved in the .blend file."""
_shown: dict[Path, monitor.Curve] = {}
"""Run folder -> the curve that its preview shows."""


def draw_curve(layout: Any, folder: Path) -> None:
    """Draw the curve of the run in this folder, or the head over the footage that is tracked;
    nothing before then."""
    curve = monitor.curve(folder)
    if curve is None:
        return
    if _shown.get(folder) is not curve:
        _shown[folder] = curve
        _fill_preview(str(folder), curve[0])
    column = layout.column(align=True)
    column.template_icon(_previews[str(folder)].icon_id, scale=SCALE)
    for text in filter(None, curve[1:]):
        column.label(text=text)


def _fill_preview(name: str, pixels: np.ndarray) -> None:
    _previews.pop(name, None)  # a new one, because Blender keeps the texture of the old one
    preview = _previews.new(name)
    preview.image_size = pixels.shape[1], pixels.shape[0]
    preview.image_pixels_float.foreach_set(np.ascontiguousarray(pixels).ravel())


def register() -> None:
    global _previews
    _previews = bpy.utils.previews.new()


def unregister() -> None:
    bpy.utils.previews.remove(_previews)
    _shown.clear()
