"""The sidebar tab: Track → Capture → Select → Train → Show → Motion."""

from typing import Any

import bpy

from ..operators import ids
from ..operators.common import is_head, register_classes, scene_settings, unregister_classes
from ..operators.preview_images import GRAY
from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import modifier_input_owner
from ..stga_addon.scene.display import splat_nodes
from ..stga_addon.scene.display.splat_nodes import AS_TRAINED, LIMITS
from ..stga_addon.scene.display.splat_object import (
    display_mode,
    input_identifier,
    splat_modifier,
    view_transform_hint,
)
from ..stga_addon.scene.objects import layers_of
from ..stga_addon.scene.render import viewport_display
from . import lighting
from .continue_panel import ContinuePanel
from .drive import DrivePanel
from .effects import EffectsPanel
from .motion import CoefficientsPanel, FacePanel, MotionPanel, TrainedPanel
from .next_step import NextStepPanel
from .render_panel import RenderPanel
from .select_panel import SelectedFrames, SelectPanel
from .sidebar import SidebarPanel
from .text import draw_text
from .track_panel import TrackCheckPanel, TrackOptionsPanel, TrackPanel
from .train_panel import TrainOptionsPanel, TrainPanel

DISPLAY_INPUTS = (
    splat_nodes.SIZE,
    splat_nodes.OPACITY_THRESHOLD,
    splat_nodes.PERCENTAGE,
    splat_nodes.VIEW_DEPENDENT,
    splat_nodes.SHOW_SELECTION,
    splat_nodes.SELECTED_ONLY,
)


class CapturePanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_capture"
    bl_label = "1 Capture"

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        layout.operator(ids.IMPORT_CAPTURE, icon="IMPORT")
        row = layout.row(align=True)
        row.operator(ids.IMPORT_MOTION, text="FLAME Motion", icon="ARMATURE_DATA")
        row.operator(ids.IMPORT_MESHES, text="Meshes", icon="MESH_DATA")
        layout.prop(settings, "head")
        if is_head(settings.head):
            layout.label(
                text=f"{len(settings.head[tags.TIMESTEPS])} timesteps, "
                f"{len(settings.head.data.polygons)} triangles"
            )
            _draw_visibility(layout, context, settings.head.parent)


def _draw_visibility(layout: Any, context: Any, root: Any) -> None:
    """Draw switches that show and hide the bones and the cameras in viewports."""
    row = layout.row(align=True)
    for kind, text, icon in (
        (tags.RIG, "Bones", "BONE_DATA"),
        (tags.CAMERA, "Cameras", "CAMERA_DATA"),
    ):
        for layer in layers_of(root, kind, context.view_layer) if root is not None else ():
            row.prop(
                layer, "hide_viewport", text=text, icon=icon, toggle=True, invert_checkbox=True
            )


class ShowPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_show"
    bl_label = "4 Show"

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        layout.prop(settings, "avatar")
        layout.operator(ids.SHOW_AVATAR, icon="HIDE_OFF").filepath = settings.avatar
        layout.operator(ids.EXPORT_AVATAR, icon="EXPORT").avatar = settings.avatar
        layout.prop(settings, "splats")
        if settings.splats is not None:
            self._draw_display(layout, context, settings.splats)

    def _draw_display(self, layout: Any, context: Any, splats: Any) -> None:
        try:
            modifier = splat_modifier(splats)
        except StgaError as error:
            layout.label(text=str(error), icon="ERROR")
            return
        mode = display_mode(splats)
        layout.operator_menu_enum(ids.CHOOSE_DISPLAY, "display", text=f"Display: {mode}")
        column = layout.column(align=True)
        for name in DISPLAY_INPUTS:
            identifier = input_identifier(modifier, name)
            if identifier is not None:
                owner, prop = modifier_input_owner(modifier, identifier)
                column.prop(owner, prop, text=name)
        if viewport_display.display.problem:
            draw_text(layout, context, viewport_display.display.problem, "ERROR")
        if mode == AS_TRAINED:
            layout.operator(ids.PREVIEW_IMAGES, icon="SHADING_RENDERED")
            return
        if viewport_display.is_engine_view(context):  # shows every display as trained
            return
        draw_text(layout, context, LIMITS.get(mode, ""), "INFO")
        if context.space_data.shading.type in GRAY:
            show = layout.operator(ids.CHOOSE_DISPLAY, text="Show Colors", icon="SHADING_TEXTURE")
            show.display = mode
        elif view_transform_hint(context.scene):
            layout.label(text="View transform changes the colors", icon="ERROR")
            layout.operator(ids.STANDARD_VIEW)


CLASSES = (
    NextStepPanel,
    TrackPanel,
    TrackOptionsPanel,
    TrackCheckPanel,
    CapturePanel,
    SelectedFrames,
    SelectPanel,
    TrainPanel,
    TrainOptionsPanel,
    ContinuePanel,
    EffectsPanel,
    ShowPanel,
    lighting.LightingPanel,
    MotionPanel,
    FacePanel,
    DrivePanel,
    TrainedPanel,
    CoefficientsPanel,
    RenderPanel,
)


def register() -> None:
    register_classes(CLASSES)
    lighting.register()


def unregister() -> None:
    lighting.unregister()
    unregister_classes(CLASSES)
