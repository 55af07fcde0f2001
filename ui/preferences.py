"""What holds for every .blend file of this user."""

from typing import Any

import bpy

from ..operators import ids, monitor
from ..operators.common import register_classes, unregister_classes
from ..operators.environment import runtime_folder
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.worker.environment import made_python, task_folder
from ..stga_addon.worker.process import State
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

    runtime_python: bpy.props.StringProperty(
        name="Python",
        description="An interpreter that has torch, numba and what else training needs; empty: the runtime made here",
        subtype="FILE_PATH",
    )

    def draw(self, context: Any) -> None:
        self.layout.prop(self, "flame_model")
        _draw_runtime(self.layout.box(), context, self)


def _draw_runtime(box: Any, context: Any, stored: Any) -> None:
    folder = task_folder(runtime_folder())
    now = monitor.snapshot(folder)
    box.label(text="Training Runtime")
    row = box.split(factor=0.8, align=True)
    row.prop(stored, "runtime_python")
    row.operator(ids.TEST_ENVIRONMENT)
    made = made_python(runtime_folder())
    if made is not None:
        box.label(text=f"Made here: {made}", icon="CHECKMARK")
    if now.state.is_alive:
        row = box.row(align=True)
        row.progress(factor=now.status.share, text=now.status.message)
        row.operator(ids.CANCEL_ENVIRONMENT, text="", icon="CANCEL")
        box.label(text=now.status.remark)
        return
    if now.state.failed:
        box.label(text="Failed", icon="ERROR")
        draw_failure(box, context, now.status.error, now.tail, folder)
    elif now.state == State.FINISHED:
        box.label(text=now.status.message, icon="CHECKMARK")
    box.operator(ids.MAKE_ENVIRONMENT, text="Make Runtime…", icon="IMPORT")


def register() -> None:
    register_classes((Preferences,))


def unregister() -> None:
    unregister_classes((Preferences,))
