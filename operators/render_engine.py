"""Registers the GPU display and the render engine, with the Python that renders where Blender's own cannot."""

import bpy

from ..stga_addon.scene.gpu import viewport_display
from ..stga_addon.scene.render import engine
from .environment import training_python


def register() -> None:
    engine.register(lambda: training_python(bpy.context))
    viewport_display.register()


def unregister() -> None:
    viewport_display.unregister()
    engine.unregister()
