"""Registers the GPU display and the render engine, and says who renders where Blender has no GPU context."""

from typing import Any

import bpy

from ..stga_addon.scene.gpu import viewport_display
from ..stga_addon.scene.render import engine
from .common import preferences
from .environment import training_python


def render_device_property() -> Any:
    """Rendering device: of the preferences."""
    return bpy.props.EnumProperty(
        name="Rendering Device",
        description="Device that renders splats for videos, and for images where Blender has no GPU context",
        items=(
            ("auto", "Auto", "A GPU if one is faster than the CPU and right, else the CPU"),
            ("cpu", "CPU", "The processor"),
            ("gpu", "GPU", "A GPU; rendering fails if none works"),
        ),
    )


def render_device() -> str:
    """The rendering device in the preferences, as `raster.compose.Composer` takes it."""
    stored = preferences(bpy.context)
    return str(stored.render_device) if stored else "auto"


def register() -> None:
    engine.register(lambda: training_python(bpy.context), render_device)
    viewport_display.register()


def unregister() -> None:
    viewport_display.unregister()
    engine.unregister()
