"""The Show step: the avatar, its display, and which light it shows, of which images that show
another one say so; render properties of the engine STGA Splats."""

from contextlib import suppress
from functools import partial
from textwrap import wrap
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..operators.common import AtEnd, register_handlers
from ..operators.show import GRAY, leaves_out_set
from ..operators.training_python import has_training_python
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.table import Kind
from ..stga_addon.render.client import missing_packages
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import modifier_input_owner
from ..stga_addon.scene.display import splat_nodes, splat_object
from ..stga_addon.scene.display.splat_attributes import UNSEEN
from ..stga_addon.scene.display.splat_nodes import AS_TRAINED, LIMITS, NATIVE
from ..stga_addon.scene.display.splat_object import shows_nodes
from ..stga_addon.scene.gpu.context import has_gpu_context
from ..stga_addon.scene.light import MODE_CHANGED, lighting_settings, throws_shadow, world_light
from ..stga_addon.scene.render import lens, viewport_display
from ..stga_addon.scene.render.film_set import shows_set
from ..stga_addon.scene.render.scene_splats import level_exposure, light_hint
from ..stga_addon.scene.render.viewport_display import ENGINE
from .sidebar import SidebarPanel, columns, draw_running, draw_text

DISPLAY_INPUTS = (
    splat_nodes.SIZE,
    splat_nodes.OPACITY_THRESHOLD,
    splat_nodes.PERCENTAGE,
    splat_nodes.VIEW_DEPENDENT,
    splat_nodes.SHOW_SELECTION,
    splat_nodes.SELECTED_ONLY,
)
"""Inputs of the splats' modifier that every avatar has in the panel."""
UNSEEN_INPUTS = (splat_nodes.SHOW_UNSEEN, splat_nodes.FILMED_ONLY)
"""Inputs of avatars that know what was filmed."""
POPUP_MARGIN_PX = 60
"""Width of a window that a popup's text leaves free."""
_is_reported = False
"""Whether the render job in progress has said what it does not show."""


class ShowPanel(SidebarPanel, bpy.types.Panel):
    bl_label = "4 Show"

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = context.scene.stga
        layout.prop(settings, "avatar")
        layout.operator("stga.show_avatar", icon="HIDE_OFF").filepath = settings.avatar
        layout.operator("stga.export_avatar", icon="EXPORT").avatar = settings.avatar
        layout.prop(settings, "splats")
        if settings.splats is None:
            return
        try:
            modifier = splat_object.splat_modifier(settings.splats)
        except StgaError as error:
            layout.label(text=str(error), icon="ERROR")
            return
        sides = settings.splats.get(tags.OBSERVED)
        if sides:
            draw_text(layout, context, sides.capitalize(), "INFO")
        lost = splat_object.triangles_hint(settings.splats, context.view_layer.depsgraph)
        if lost:
            draw_text(layout, context, lost, "ERROR")
        mode = splat_object.display_mode(settings.splats)
        layout.operator_menu_enum("stga.choose_display", "display", text=f"Display: {mode}")
        column = layout.column(align=True)
        knows = UNSEEN in settings.splats.data.attributes
        for name in (*DISPLAY_INPUTS, *(UNSEEN_INPUTS if knows else ())):
            draw_input(column, modifier, name)
        if viewport_display.display.problem:
            draw_text(layout, context, viewport_display.display.problem, "ERROR")
        if mode == AS_TRAINED:
            layout.operator("stga.preview_images", icon="SHADING_RENDERED")
            return
        if viewport_display.is_engine_view(context):  # shows every display as trained
            return
        draw_text(layout, context, LIMITS.get(mode, ""), "INFO")
        is_avatar = tags.CONVENTION in settings.splats
        if mode == NATIVE:
            draw_input(layout, modifier, splat_nodes.NATIVE_LIGHT)
        if mode == NATIVE and is_avatar and not draw_running(layout, context, Kind.EXACT):
            layout.operator("stga.make_exact").directory = settings.run_folder
        if context.space_data.shading.type in GRAY:
            choose = "stga.choose_display"
            show = layout.operator(choose, text="Show Colors", icon="SHADING_TEXTURE")
            show.display = mode
        elif splat_object.view_transform_hint(context.scene):
            layout.label(text="View transform changes the colors", icon="ERROR")
            layout.operator("stga.standard_view")


def draw_input(layout: Any, modifier: Any, name: str, **how: Any) -> None:
    """Draw an input of the splats' node tree, where this display has it."""
    identifier = splat_object.input_identifier(modifier, name)
    if identifier is not None:
        owner, prop = modifier_input_owner(modifier, identifier)
        layout.prop(owner, prop, text=name, **how)


class LightingPanel(SidebarPanel, bpy.types.Panel):
    bl_parent_id = ShowPanel.bl_idname
    bl_label = "Lighting"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return context.scene.stga.splats is not None

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = lighting_settings(context.scene)
        light = splat_object.stored_light(context.scene.stga.splats)
        if light is None:
            draw_text(layout, context, "The avatar does not know the light of its capture", "INFO")
            if not draw_running(layout, context, Kind.LIGHT):
                folder = context.scene.stga.run_folder
                layout.operator("stga.estimate_light", icon="LIGHT_SUN").directory = folder
            return
        layout.row().prop(settings, "mode", expand=True)
        hint = light_hint(context.scene)
        if hint:
            draw_text(layout, context, hint, "ERROR" if shows_nodes(context.scene) else "INFO")
        if settings.mode != "recorded":
            column = layout.column()
            column.use_property_split = True
            if settings.mode == "mix":
                column.prop(settings, "mix")
            names = ("exposure", "white", "roughness", "specular", "shadows", "world", "lights")
            for name in names:
                column.prop(settings, name)
            if settings.world and world_light(context.scene.world) is None:
                hint = "Of worlds, colors and environment textures count"
                draw_text(layout, context, hint, "ERROR")
        if light.damping:
            text = f"The capture's light was hard: albedo is evened out by {light.damping:.0%}"
            draw_text(layout, context, text, "INFO")
        row = layout.row(align=True)
        row.operator("stga.relight_frame")
        row.operator("stga.relight_frame", text="", icon="X").clear = True
        splats = context.scene.stga.splats
        # native splats throw their own
        if splat_object.display_mode(splats) != NATIVE or throws_shadow(splats):
            layout.operator("stga.head_shadow")


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
    global _is_reported
    _is_reported = False


@persistent
def _before_image(scene: Any, *_: Any) -> None:
    """Report once a job that an image does not show the scene's light, or its other objects."""
    global _is_reported
    if _is_reported:
        return
    hint = light_hint(scene) if shows_nodes(scene) else left_out_hint(scene)
    if hint:
        _is_reported = True
        print(f"STGA: {hint}")
        if not bpy.app.background:  # this is the job's thread
            bpy.app.timers.register(partial(_pop_up, hint))


def left_out_hint(scene: Any) -> str | None:
    """A sentence where the engine STGA Splats leaves out what the scene's images are to show, or
    where another engine shows it twice."""
    if scene.render.engine != ENGINE:
        twice = "EEVEE and Cycles show all objects by themselves; leave out the set of STGA Splats"
        return twice if shows_set(scene) else None
    where = "Set: Shown, in the render properties, shows them"
    return f"STGA Splats leaves out other objects; {where}" if leaves_out_set(scene) else None


def draw_left_out(layout: Any, context: Any) -> None:
    """Say that images lack the set, or show it twice, with the button that changes it."""
    hint = left_out_hint(context.scene)
    if hint:
        is_visible = shows_set(context.scene)
        draw_text(layout, context, hint, "INFO")
        text = "Leave Out Set" if is_visible else "Show Set"
        button = layout.operator("stga.choose_set", text=text, icon="SCENE_DATA")
        button.shown = "LEFT_OUT" if is_visible else "SHOWN"


def _pop_up(hint: str) -> None:
    """Show the sentence in the window that was opened last: that of the image, where it has one."""
    manager = bpy.context.window_manager
    window = manager.windows[-1]
    lines = wrap(hint, columns(bpy.context, window.width - POPUP_MARGIN_PX))

    def draw(menu: Any, _: Any) -> None:
        for line in lines:
            menu.layout.label(text=line)

    with bpy.context.temp_override(window=window):
        manager.popup_menu(draw, title="STGA", icon="ERROR")


class RenderPanel(bpy.types.Panel):
    bl_idname = "STGA_PT_render"
    bl_label = "STGA Splats"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return bool(context.scene.render.engine == ENGINE)

    def draw(self, context: Any) -> None:
        layout = self.layout
        has_python = has_training_python(context)
        layout.use_property_split = True
        state = "Shown" if shows_set(context.scene) else "Left Out"
        layout.operator_menu_enum("stga.choose_set", "shown", text=f"Set: {state}")
        if lens.is_blurred(context.scene):
            layout.prop(context.scene.eevee, "taa_render_samples", text="Samples")
            draw_text(layout, context, "Each sample takes the time of an image", "INFO")
        layout.prop(context.scene.render, "film_transparent", text="Transparent Film")
        layout.prop(context.view_layer, "use_pass_z", text="Depth Pass")
        layout.prop(context.view_layer, "use_pass_vector", text="Vector Pass")
        if missing_packages() and not has_gpu_context():
            renderer = "Rendered by another Python" if has_python else "No Python here can render"
            lacks = f"Blender's Python lacks {', '.join(missing_packages())}"
            draw_text(layout, context, f"{renderer}: {lacks}", "INFO")


def register(at_end: AtEnd) -> None:
    handlers = bpy.app.handlers
    rendering = (handlers.render_init, _before_job), (handlers.render_pre, _before_image)
    register_handlers(at_end, (MODE_CHANGED, _begin_exposure), *rendering)
