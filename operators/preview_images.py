"""Chooses how splats are displayed, and the shading that shows it."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.scene.compat import NATIVE_SPLATS
from ..stga_addon.scene.display.splat_nodes import (
    AS_TRAINED,
    DISPLAY,
    LIMITS,
    NATIVE,
    POINTS,
    QUADS,
)
from ..stga_addon.scene.display.splat_object import (
    set_input,
    shows_nodes,
    use_transparent_bounces,
    view_transform_hint,
)
from ..stga_addon.scene.render.viewport_display import is_shown_as_trained
from . import ids
from .common import polled, reporting, scene_settings, tell

GRAY = ("WIREFRAME", "SOLID")
"""Kinds of shading that show colors of splats as trained only."""
OFFERED = [mode for mode in LIMITS if mode != NATIVE or NATIVE_SPLATS]


class ChooseDisplay(bpy.types.Operator):
    """Choose how the splats are displayed, in a shading that shows their colors"""

    bl_idname = ids.CHOOSE_DISPLAY
    bl_label = "Display"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    display: bpy.props.EnumProperty(
        name="Display", items=[(mode, mode, LIMITS[mode]) for mode in OFFERED]
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        splats = scene_settings(context).splats
        return polled(cls, splats is not None and splats.library is None, "Show an avatar first")

    @reporting
    def execute(self, context: Any) -> set[str]:
        set_input(scene_settings(context).splats, DISPLAY, self.display)
        space = context.space_data
        is_viewport = getattr(space, "type", "") == "VIEW_3D"  # a script has none
        if is_viewport and self.display != AS_TRAINED and space.shading.type in GRAY:
            space.shading.type = "MATERIAL"
        return {"FINISHED"}


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
        if hint := view_transform_hint(scene):
            tell(self, "WARNING", hint)
        else:
            self.report({"INFO"}, f"{mode}: {LIMITS[mode]}")
        return {"FINISHED"}


def _own_as_trained(context: Any) -> list[Any]:
    """The splat objects that are displayed as trained, but linked ones, whose display cannot be
    changed."""
    return [
        thing
        for thing in context.view_layer.objects
        if thing.library is None and is_shown_as_trained(thing)
    ]
