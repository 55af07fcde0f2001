"""The light of avatars: estimated from the capture, and their shadows onto the scene."""

from contextlib import suppress
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.finished_run import Relight
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene.display import splat_nodes
from ..stga_addon.scene.display.splat_object import get_input
from ..stga_addon.scene.light import throw_shadow, throws_shadow
from ..stga_addon.scene.render.scene_splats import forget_frame, relight_frame
from . import ids
from .common import file_path, flame_model_path, path_property, polled, reporting, scene_settings
from .request import needs_idle, start
from .training_python import training_python


def _needs_splats(operator: Any, context: Any) -> bool:
    splats, head = scene_settings(context).splats, None
    with suppress(StgaError):
        head = None if splats is None else get_input(splats, splat_nodes.HEAD)
    return polled(operator, head is not None, "Show an avatar first")


class EstimateLight(bpy.types.Operator):
    """Find out the light of the capture that the avatar was trained on, so that the scene can light
    the avatar"""

    bl_idname = ids.ESTIMATE_LIGHT
    bl_label = "Estimate Light"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    directory: path_property("Run Folder", "Folder of the avatar's run", "DIR_PATH")

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.LIGHT) and _needs_splats(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        run = file_path(self.directory or scene_settings(context).run_folder, "run folder")
        start(
            context.scene, Relight(run, flame=flame_model_path(context)), training_python(context)
        )
        return {"FINISHED"}


class RelightFrame(bpy.types.Operator):
    """Give the splats the colors of the scene's light at this frame, for EEVEE and Cycles; other
    frames keep them"""

    bl_idname = ids.RELIGHT_FRAME
    bl_label = "Relight Frame"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    clear: bpy.props.BoolProperty(
        name="Clear", description="Show recorded colors again", default=False, options={"SKIP_SAVE"}
    )

    poll = classmethod(_needs_splats)

    @reporting
    def execute(self, context: Any) -> set[str]:
        splats = scene_settings(context).splats
        if self.clear:
            forget_frame(splats)
        else:
            relight_frame(splats, context.scene)
        return {"FINISHED"}


class HeadShadow(bpy.types.Operator):
    """Let the head's mesh throw shadows onto other objects in EEVEE and Cycles, without being seen;
    again: hide it"""

    bl_idname = ids.HEAD_SHADOW
    bl_label = "Head Shadow"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    poll = classmethod(_needs_splats)

    def execute(self, context: Any) -> set[str]:
        splats = scene_settings(context).splats
        is_on = not throws_shadow(splats)
        throw_shadow(splats, is_on)
        self.report({"INFO"}, "The head throws shadows" if is_on else "The head throws no shadows")
        return {"FINISHED"}
