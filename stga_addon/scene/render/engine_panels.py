"""Blender's own panels that apply to the render engine, too."""

from typing import Any

import bpy

from .viewport_display import ENGINE

# Those that are for some engines only and apply to this one too.
SHARED_PANELS = ("EEVEE_WORLD_PT_surface", "VIEWLAYER_PT_layer")


def add_engine() -> None:
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def remove_engine() -> None:
    for panel in _panels_by_engine():
        panel.COMPAT_ENGINES.discard(ENGINE)


def _panels_by_engine() -> list[Any]:
    """The panels that list the engines they are for."""
    return [panel for panel in bpy.types.Panel.__subclasses__() if hasattr(panel, "COMPAT_ENGINES")]


def _shared_panels() -> list[Any]:
    return [
        panel
        for panel in _panels_by_engine()
        if "BLENDER_RENDER" in panel.COMPAT_ENGINES or panel.__name__ in SHARED_PANELS
    ]
