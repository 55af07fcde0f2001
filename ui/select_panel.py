"""The Capture and Select steps: the imported head, regions selected as a whole, table of selected
triangles, heat map."""

from typing import Any

import bpy

from ..operators.select import key_regions, possible_regions
from ..stga_addon.capture.coverage import directions_picture
from ..stga_addon.scene import tags
from ..stga_addon.scene.objects import layers_of
from ..stga_addon.scene.tags import is_head
from ..stga_addon.scene.vertex_groups import has_heat_map, shows_residuals
from .sidebar import SidebarPanel, draw_arrow, draw_picture, draw_text

LAYERS = ((tags.RIG, "Bones", "BONE_DATA"), (tags.CAMERA, "Cameras", "CAMERA_DATA"))
"""Collections that switches show and hide in viewports."""


class CapturePanel(SidebarPanel, bpy.types.Panel):
    bl_label = "1 Capture"

    def draw(self, context: Any) -> None:
        layout = self.layout
        head = context.scene.stga.head
        layout.operator("stga.import_capture", icon="IMPORT")
        column = layout.column(align=True)
        column.operator("stga.import_avatar", text="Avatar", icon="USER")
        column.operator("stga.import_motion", text="FLAME Motion", icon="ARMATURE_DATA")
        column.operator("stga.import_meshes", text="Meshes", icon="MESH_DATA")
        layout.prop(context.scene.stga, "head")
        if not is_head(head):
            return
        timesteps = len(head[tags.TIMESTEPS])
        triangles = len(head.data.polygons)
        layout.label(text=f"{timesteps} timesteps, {triangles} triangles")
        row = layout.row(align=True)
        root = head.parent
        toggle = {"toggle": True, "invert_checkbox": True}
        row.prop(head, "hide_viewport", text="Head", icon="USER", **toggle)
        for kind, text, icon in LAYERS if root is not None else ():
            how = {"text": text, "icon": icon, **toggle}
            for layer in layers_of(root, kind, context.view_layer):
                row.prop(layer, "hide_viewport", **how)
        row = layout.row(align=True)
        row.operator("stga.duplicate_avatar", icon="DUPLICATE")
        row.operator("stga.duplicate_avatar", text="", icon="LINKED").linked = True
        if tags.OBSERVED_CELLS in head:
            draw_coverage(layout, context, head)


def draw_coverage(layout: Any, context: Any, head: Any) -> None:
    """Draw from where the head was filmed, and, before it has splats, what to film next: these may
    be of further takes."""
    settings = context.scene.stga
    if not draw_arrow(layout, settings, "show_filmed", "Filmed"):
        return
    draw_picture(layout, head.name, directions_picture(tuple(head[tags.OBSERVED_CELLS])))
    lines = head[tags.OBSERVED].splitlines()
    for text in lines if settings.splats is None else lines[:1]:
        draw_text(layout, context, text)


class SelectedFrames(bpy.types.UIList):
    """Frame, triangles and splats of each frame; the row of the scene's frame is chosen."""

    bl_idname = "STGA_UL_selected_frames"

    def draw_item(
        self, context: Any, layout: Any, data: Any, item: Any, icon: int, active_data: Any
    ) -> None:
        row = layout.row()
        row.active = item.triangles > 0
        for value in (item.frame, item.triangles, item.splats):
            row.label(text=f"{value:,}")


class SelectPanel(SidebarPanel, bpy.types.Panel):
    bl_label = "2 Select"

    def draw(self, context: Any) -> None:
        layout = self.layout
        settings = context.scene.stga
        head = settings.head
        layout.operator("stga.select", icon="GROUP_VERTEX")
        if not is_head(head):
            return
        possible = possible_regions(head)
        ticked = key_regions(head)
        if possible:
            layout.label(text="Whole Regions")
            grid = layout.grid_flow(columns=2, align=True, row_major=True)
        for name in possible:
            is_on = name in ticked
            how = {"icon": "CHECKBOX_HLT" if is_on else "CHECKBOX_DEHLT", "depress": is_on}
            grid.operator("stga.toggle_region", text=name.replace("_", " "), **how).name = name
        if settings.selected_frames:
            heading = layout.row()
            for text in ("Frame", "Triangles", "Splats"):
                heading.label(text=text)
            rows = (settings, "selected_frames", settings, "selected_row")
            layout.template_list(SelectedFrames.bl_idname, "", *rows, rows=4, maxrows=5)
        if not has_selection(head):
            layout.label(text="No selection yet")
            return
        row = layout.row(align=True)
        row.operator("stga.count_selected", icon="FILE_REFRESH")
        is_visible = has_heat_map(head) and not shows_residuals(head)
        how = {"text": "Hide Heat Map" if is_visible else "Show Heat Map", "depress": is_visible}
        row.operator("stga.heat_map", icon="BRUSHES_ALL", **how).show = not is_visible


def has_selection(head: Any) -> bool:
    """Whether a head has a vertex group that is the selection of a frame."""
    return any(tags.group_timestep(group.name) is not None for group in head.vertex_groups)
