"""The sidebar tab: Capture → Select → Train → Show."""

from typing import Any

import bpy

from ..operators import ids
from ..operators.common import is_head, register_classes, settings, unregister_classes
from ..stga_addon.errors import StgaError
from ..stga_addon.scene import nodes, tags
from ..stga_addon.scene.compat import modifier_input_owner
from ..stga_addon.scene.materials import view_transform_hint
from ..stga_addon.scene.splats import input_identifier, splat_modifier

DISPLAY_INPUTS = (nodes.ELLIPSOIDS, nodes.SIZE, nodes.OPACITY_THRESHOLD, nodes.PERCENTAGE, nodes.SHOW_SELECTION)


class _Step:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "STGA"


class CapturePanel(_Step, bpy.types.Panel):
    bl_idname = "STGA_PT_capture"
    bl_label = "1 Capture"

    def draw(self, context: Any) -> None:
        layout, chosen = self.layout, settings(context)
        layout.operator(ids.IMPORT_CAPTURE, icon="IMPORT")
        layout.prop(chosen, "head")
        if is_head(chosen.head):
            layout.label(
                text=f"{len(chosen.head[tags.TIMESTEPS])} timesteps, {len(chosen.head.data.polygons)} triangles"
            )


class SelectPanel(_Step, bpy.types.Panel):
    bl_idname = "STGA_PT_select"
    bl_label = "2 Select"

    def draw(self, context: Any) -> None:
        layout, head = self.layout, settings(context).head
        layout.operator(ids.SELECT, icon="GROUP_VERTEX")
        if is_head(head):
            frames = sum(tags.group_timestep(group.name) is not None for group in head.vertex_groups)
            layout.label(text=f"{frames} frames have a selection" if frames else "No selection yet")


class TrainPanel(_Step, bpy.types.Panel):
    bl_idname = "STGA_PT_train"
    bl_label = "3 Train"

    def draw(self, context: Any) -> None:
        layout, chosen = self.layout, settings(context)
        layout.prop(chosen, "run_folder")
        layout.prop(chosen, "resume")
        column = layout.column()
        column.active = not chosen.resume  # a run that goes on keeps its budget and strategy
        column.prop(chosen, "minutes")
        column.prop(chosen, "strategy")
        train = layout.operator(ids.TRAIN, icon="PLAY")
        train.directory, train.minutes, train.resume = chosen.run_folder, chosen.minutes, chosen.resume
        train.strategy = chosen.strategy


class ShowPanel(_Step, bpy.types.Panel):
    bl_idname = "STGA_PT_show"
    bl_label = "4 Show"

    def draw(self, context: Any) -> None:
        layout, chosen = self.layout, settings(context)
        layout.prop(chosen, "avatar")
        layout.operator(ids.SHOW_AVATAR, icon="HIDE_OFF").filepath = chosen.avatar
        layout.operator(ids.EXPORT, icon="EXPORT").avatar = chosen.avatar
        layout.prop(chosen, "splats")
        if chosen.splats is not None:
            self._draw_display(layout, context, chosen.splats)

    def _draw_display(self, layout: Any, context: Any, splats: Any) -> None:
        try:
            modifier = splat_modifier(splats)
        except StgaError as error:
            layout.label(text=str(error), icon="ERROR")
            return
        column = layout.column(align=True)
        for name in DISPLAY_INPUTS:
            identifier = input_identifier(modifier, name)
            if identifier is not None:
                owner, prop = modifier_input_owner(modifier, identifier)
                column.prop(owner, prop, text=name)
        if view_transform_hint(context.scene):
            layout.label(text="View transform changes the colours", icon="ERROR")
            layout.operator(ids.STANDARD_VIEW)


CLASSES = (CapturePanel, SelectPanel, TrainPanel, ShowPanel)


def register() -> None:
    register_classes(CLASSES)


def unregister() -> None:
    unregister_classes(CLASSES)
