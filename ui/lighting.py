"""The panel Lighting: which light avatars show."""

from typing import Any

import bpy

from ..operators import ids
from ..operators.common import scene_settings
from ..stga_addon.errors import StgaError
from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.scene.display import splat_nodes
from ..stga_addon.scene.display.splat_object import get_input
from ..stga_addon.scene.display.stored_light import read_light
from ..stga_addon.scene.light.settings import lighting_settings
from ..stga_addon.scene.light.world import world_light
from .request import draw_running
from .sidebar import SidebarPanel
from .text import draw_text


class LightingPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_lighting"
    bl_parent_id = "STGA_PT_show"
    bl_label = "Lighting"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return scene_settings(context).splats is not None

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, lighting_settings(context.scene)
        light = _light(scene_settings(context).splats)
        if light is None:
            draw_text(layout, context, "The avatar does not know the light of its capture", "INFO")
            if not draw_running(layout, context, Kind.LIGHT):
                folder = scene_settings(context).run_folder
                layout.operator(ids.ESTIMATE_LIGHT, icon="LIGHT_SUN").directory = folder
            return
        layout.row().prop(settings, "mode", expand=True)
        if settings.mode != "recorded":
            self._draw_settings(layout, context, settings)
        if light.damping:
            draw_text(
                layout, context, f"The capture's light was hard: albedo is evened out by {light.damping:.0%}", "INFO"
            )
        row = layout.row(align=True)
        row.operator(ids.RELIGHT_FRAME, text="Relight Frame (EEVEE, Cycles)")
        row.operator(ids.RELIGHT_FRAME, text="", icon="X").clear = True
        layout.operator(ids.HEAD_SHADOW)

    def _draw_settings(self, layout: Any, context: Any, settings: Any) -> None:
        column = layout.column()
        column.use_property_split = True
        if settings.mode == "mix":
            column.prop(settings, "mix")
        for name in ("exposure", "white", "roughness", "specular", "shadows", "world", "lights"):
            column.prop(settings, name)
        if settings.world and world_light(context.scene.world) is None:
            text = "The world's nodes are not understood: a Background with a color or an environment texture is"
            draw_text(layout, context, text, "ERROR")


def _light(splats: Any) -> Any:
    try:
        neutral = get_input(splats, splat_nodes.NEUTRAL)
    except StgaError:
        return None
    return None if neutral is None else read_light(neutral.data)
