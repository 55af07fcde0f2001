"""Preferences of the add-on: the FLAME model, the Python that tracks and trains, and the device
that renders."""

from typing import Any

import bpy

from ..operators import options
from ..operators.common import AtEnd, package, register_classes
from ..operators.training_python import has_training_python, test
from ..stga_addon.worker.training_python import PYTHON_VARIABLE
from .sidebar import draw_text


class Preferences(bpy.types.AddonPreferences):
    bl_idname = package()

    flame_model: options.path(
        "FLAME Model",
        "Your own FLAME model file (.pkl or .npz), from flame.is.tue.mpg.de; needed for captures "
        "tracked with FLAME, and never part of this add-on",
    )
    training_python: options.text(
        "Python",
        "An interpreter that has torch, numba and what else tracking and training need; empty: "
        "Blender's own, which has it all with the complete edition. The variable "
        f"{PYTHON_VARIABLE} takes precedence",
        subtype="FILE_PATH",
    )
    render_device: options.choice(
        "Rendering Device",
        "Device that renders splats for videos, and for images where Blender has no GPU context",
        ("auto", "Auto", "A GPU if one is faster than the CPU and right, else the CPU"),
        ("cpu", "CPU", "The processor"),
        ("gpu", "GPU", "A GPU; rendering fails if none works"),
    )

    def draw(self, context: Any) -> None:
        self.layout.prop(self, "flame_model")
        self.layout.prop(self, "render_device")
        box = self.layout.box()
        row = box.split(factor=0.8, align=True)
        row.prop(self, "training_python")
        row.operator("stga.test_python")
        if test.process is not None:
            box.label(text=f"Testing {test.python}", icon="TIME")
        elif test.error:
            draw_text(box, context, test.error, "ERROR")
        elif test.found is not None:
            draw_text(box, context, f"{test.python}: {test.found.line}", "CHECKMARK")
        elif not has_training_python(context):
            remedy = "choose another, or install the complete edition"
            draw_text(box, context, f"Blender's Python lacks packages: {remedy}", "INFO")


def register(at_end: AtEnd) -> None:
    register_classes((Preferences,), at_end)
