"""Preferences of the add-on: the FLAME model, the training environment and the device that renders."""

from typing import Any

import bpy

from ..operators import ids, monitor
from ..operators.common import path_property, register_classes, unregister_classes
from ..operators.training_python import has_training_python
from ..stga_addon.requests.environment_job import CAN_MAKE
from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.worker.environment import PYTHON_VARIABLE
from ..stga_addon.worker.status import WorkerState
from .request import draw_failure, draw_running


class Preferences(bpy.types.AddonPreferences):
    bl_idname = __package__.rpartition(".")[0]

    flame_model: path_property(
        "FLAME Model",
        "Your own FLAME model file (.pkl or .npz), from flame.is.tue.mpg.de; "
        "needed for captures tracked with FLAME, and never part of this add-on",
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
    box.label(text="Training Environment")
    row = box.split(factor=0.8, align=True)
    row.prop(stored, "training_python")
    row.operator(ids.TEST_ENVIRONMENT)
    if draw_running(box, context, Kind.ENVIRONMENT):
        return
    environment = monitor.state_of(context.scene, Kind.ENVIRONMENT)
    state = environment.snapshot.state
    if state.failed:
        box.label(text="Failed", icon="ERROR")
        draw_failure(box, context, environment)
    elif state == WorkerState.FINISHED:
        box.label(text=environment.snapshot.status.message, icon="CHECKMARK")
    elif not has_training_python(context):
        box.label(text="No training environment yet", icon="INFO")
    if CAN_MAKE:
        box.operator(ids.MAKE_ENVIRONMENT, text="Make Training Environment…", icon="IMPORT")


def register() -> None:
    register_classes((Preferences,))


def unregister() -> None:
    unregister_classes((Preferences,))
