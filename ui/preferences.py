"""Preferences of the add-on: the FLAME model, the training environment and the device that renders."""

from typing import Any

import bpy

from ..operators import ids, monitor
from ..operators.common import register_classes, unregister_classes
from ..operators.environment import environment_folder, has_training_python
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.worker.environment import PYTHON_VARIABLE, status_folder
from ..stga_addon.worker.status import WorkerState
from .failure import draw_failure


class Preferences(bpy.types.AddonPreferences):
    bl_idname = __package__.rpartition(".")[0]

    flame_model: bpy.props.StringProperty(
        name="FLAME Model",
        description="Your own FLAME model file (.pkl or .npz), from flame.is.tue.mpg.de; "
        "needed for captures tracked with FLAME, and never part of this add-on",
        subtype="FILE_PATH",
        options=PATH_OPTIONS,
    )

    training_python: bpy.props.StringProperty(
        name="Python",
        description="An interpreter that has torch, numba and what else training needs; empty: the one chosen with "
        f"`stga environment use`, or the environment made here. The variable {PYTHON_VARIABLE} takes precedence",
        subtype="FILE_PATH",
    )

    render_device: bpy.props.EnumProperty(
        name="Rendering Device",
        description="Device that renders splats for videos, and for images where Blender has no GPU context",
        items=(
            ("auto", "Auto", "A GPU if one is faster than the CPU and right, else the CPU"),
            ("cpu", "CPU", "The processor"),
            ("gpu", "GPU", "A GPU; rendering fails if none works"),
        ),
    )

    def draw(self, context: Any) -> None:
        self.layout.prop(self, "flame_model")
        self.layout.prop(self, "render_device")
        _draw_environment(self.layout.box(), context, self)


def _draw_environment(box: Any, context: Any, stored: Any) -> None:
    folder = status_folder(environment_folder())
    now = monitor.snapshot(folder)
    box.label(text="Training Environment")
    row = box.split(factor=0.8, align=True)
    row.prop(stored, "training_python")
    row.operator(ids.TEST_ENVIRONMENT)
    if now.state.is_alive:
        row = box.row(align=True)
        row.progress(factor=now.status.progress, text=now.status.message)
        row.operator(ids.CANCEL_ENVIRONMENT, text="", icon="CANCEL")
        box.label(text=now.status.detail)
        return
    if now.state.failed:
        box.label(text="Failed", icon="ERROR")
        draw_failure(box, context, now.status.error, now.log_tail, folder)
    elif now.state == WorkerState.FINISHED:
        box.label(text=now.status.message, icon="CHECKMARK")
    elif not has_training_python(context):
        box.label(text="No training environment yet", icon="INFO")
    box.operator(ids.MAKE_ENVIRONMENT, text="Make Training Environment…", icon="IMPORT")


def register() -> None:
    register_classes((Preferences,))


def unregister() -> None:
    unregister_classes((Preferences,))
