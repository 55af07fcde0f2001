"""The panel Lighting: which light avatars show. Images that show another one say so."""

from contextlib import suppress
from functools import partial
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..operators import ids
from ..operators.common import scene_settings
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene.display.splat_object import shows_nodes, stored_light
from ..stga_addon.scene.light import MODE_CHANGED, lighting_settings, world_light
from ..stga_addon.scene.render import viewport_display
from ..stga_addon.scene.render.scene_splats import level_exposure, light_hint
from .request import draw_running
from .sidebar import SidebarPanel
from .text import draw_text

_is_told = False
"""Whether the render job in progress has said that it does not show the scene's light."""


class LightingPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_lighting"
    bl_parent_id = "STGA_PT_show"
    bl_label = "Lighting"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return scene_settings(context).splats is not None

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, lighting_settings(context.scene)
        light = stored_light(scene_settings(context).splats)
        if light is None:
            draw_text(layout, context, "The avatar does not know the light of its capture", "INFO")
            if not draw_running(layout, context, Kind.LIGHT):
                folder = scene_settings(context).run_folder
                layout.operator(ids.ESTIMATE_LIGHT, icon="LIGHT_SUN").directory = folder
            return
        layout.row().prop(settings, "mode", expand=True)
        hint = light_hint(context.scene)
        if hint:
            draw_text(layout, context, hint, "ERROR" if shows_nodes(context.scene) else "INFO")
        if settings.mode != "recorded":
            self._draw_settings(layout, context, settings)
        if light.damping:
            draw_text(
                layout,
                context,
                f"The capture's light was hard: albedo is evened out by {light.damping:.0%}",
                "INFO",
            )
        row = layout.row(align=True)
        row.operator(ids.RELIGHT_FRAME)
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
            draw_text(layout, context, "Of worlds, colors and environment textures count", "ERROR")


def _begin_exposure(scene: Any) -> None:
    """Light avatars as brightly as they were recorded, until an exposure is chosen."""
    settings = lighting_settings(scene)
    if settings.mode != "recorded" and not settings.is_property_set("exposure"):
        if bpy.context.window is not None:
            bpy.context.window.cursor_set("WAIT")  # until the mouse moves
        with suppress(StgaError):  # the display says what is wrong
            exposure = level_exposure(viewport_display.display.cache)
            if exposure is not None:
                settings.exposure = exposure


@persistent
def _before_job(*_: Any) -> None:
    global _is_told
    _is_told = False


@persistent
def _before_image(scene: Any, *_: Any) -> None:
    """Say once a job that an image does not show the scene's light."""
    global _is_told
    hint = light_hint(scene) if shows_nodes(scene) and not _is_told else None
    if hint:
        _is_told = True
        print(f"STGA: {hint}")
        if not bpy.app.background:  # this is the job's thread
            bpy.app.timers.register(partial(_pop_up, hint))


def _pop_up(hint: str) -> None:
    """Show the sentence in the window that was opened last: that of the image, where it has one."""
    manager = bpy.context.window_manager
    with bpy.context.temp_override(window=manager.windows[-1]):
        manager.popup_menu(
            lambda menu, _: menu.layout.label(text=hint), title="STGA Lighting", icon="ERROR"
        )


def register() -> None:
    MODE_CHANGED.append(_begin_exposure)
    bpy.app.handlers.render_init.append(_before_job)
    bpy.app.handlers.render_pre.append(_before_image)


def unregister() -> None:
    MODE_CHANGED.remove(_begin_exposure)
    bpy.app.handlers.render_init.remove(_before_job)
    bpy.app.handlers.render_pre.remove(_before_image)
