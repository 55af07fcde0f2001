"""The light of avatars: estimated from the capture, and their shadows onto the scene."""

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene.display import splat_nodes
from ..stga_addon.scene.display.splat_object import get_input
from ..stga_addon.scene.light.head_shadow import throw_shadow, throws_shadow
from . import ids
from .common import reporting, scene_settings


def _needs_splats(operator: Any, context: Any) -> bool:
    splats = scene_settings(context).splats
    try:
        if splats is not None and get_input(splats, splat_nodes.HEAD) is not None:
            return True
    except StgaError:
        pass
    operator.poll_message_set("Show an avatar first")
    return False


class HeadShadow(bpy.types.Operator):
    """Let the head's mesh throw shadows onto other objects in EEVEE and Cycles, without being seen; again: hide it"""

    bl_idname = ids.HEAD_SHADOW
    bl_label = "Shadow onto the Scene"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return _needs_splats(cls, context)

    def execute(self, context: Any) -> set[str]:
        splats = scene_settings(context).splats
        is_on = not throws_shadow(splats)
        throw_shadow(splats, is_on)
        self.report({"INFO"}, "The head throws shadows" if is_on else "The head throws no shadows")
        return {"FINISHED"}
