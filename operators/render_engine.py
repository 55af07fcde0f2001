"""Registers the GPU display and the render engine, and says who renders where Blender has no GPU
context."""

import bpy

from ..stga_addon.scene import light as lighting
from ..stga_addon.scene.render import engine, viewport_display
from .common import preferences
from .training_python import training_python


def render_device() -> str:
    """The rendering device in the preferences, as `render.device.Composer` takes it."""
    stored = preferences(bpy.context)
    return str(stored.render_device) if stored else "auto"


def register() -> None:
    lighting.register()
    engine.register(lambda: training_python(bpy.context), render_device)
    viewport_display.register()


def unregister() -> None:
    viewport_display.unregister()
    engine.unregister()
    lighting.unregister()
