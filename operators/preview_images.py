"""Shows splats in the viewport as EEVEE and Cycles render them."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.scene.display.display_modes import LIMITS, POINTS, QUADS
from ..stga_addon.scene.display.splat_nodes import DISPLAY
from ..stga_addon.scene.display.splat_object import (
    set_input,
    shows_nodes,
    use_transparent_bounces,
    view_transform_hint,
)
from ..stga_addon.scene.render.viewport_display import is_shown_as_trained
from . import ids
from .common import polled, reporting


class PreviewImages(bpy.types.Operator):
    """Show all splats as images by EEVEE and Cycles show them: through the scene's camera as quads
    that face it, without a camera as points. Choose the display As Trained to go back"""

    bl_idname = ids.PREVIEW_IMAGES
    bl_label = "Preview for EEVEE/Cycles"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return polled(cls, bool(_own_as_trained(context)), "No splats are displayed as trained")

    @reporting
    def execute(self, context: Any) -> set[str]:
        scene = context.scene
        mode = QUADS if scene.camera is not None else POINTS
        for thing in _own_as_trained(context):
            set_input(thing, DISPLAY, mode)
        use_transparent_bounces(scene)
        if getattr(context.space_data, "type", "") == "VIEW_3D":  # none where a script calls it
            # Material Preview is EEVEE, whatever the scene's engine is.
            context.space_data.shading.type = "RENDERED" if shows_nodes(scene) else "MATERIAL"
            if scene.camera is not None:
                context.space_data.region_3d.view_perspective = "CAMERA"
        hint = view_transform_hint(scene)
        self.report(
            {"WARNING" if hint else "INFO"},
            f"{mode}: {LIMITS[mode]}" + (f". {hint}" if hint else ""),
        )
        return {"FINISHED"}


def _own_as_trained(context: Any) -> list[Any]:
    """The splat objects that are displayed as trained, but linked ones, whose display cannot be
    changed."""
    return [
        thing
        for thing in context.view_layer.objects
        if thing.library is None and is_shown_as_trained(thing)
    ]
