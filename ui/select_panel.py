"""The Select step: regions selected as a whole, table of selected triangles, heat map."""

from typing import Any

import bpy

from ..operators import ids
from ..operators.common import is_head, scene_settings
from ..operators.select import key_regions, possible_regions
from ..stga_addon.scene import tags
from ..stga_addon.scene.vertex_groups import has_heat_map, shows_residuals
from .sidebar import SidebarPanel


class SelectedFrames(bpy.types.UIList):
    """Frame, triangles and splats of each frame; the row of the scene's frame is chosen."""

    bl_idname = "STGA_UL_selected_frames"

    def draw_item(
        self,
        context: Any,
        layout: Any,
        data: Any,
        item: Any,
        icon: int,
        active_data: Any,
        active_propname: str,
    ) -> None:
        row = layout.row()
        row.active = item.triangles > 0
        for value in (item.frame, item.triangles, item.splats):
            row.label(text=f"{value:,}")


class SelectPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_select"
    bl_label = "2 Select"

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        layout.operator(ids.SELECT, icon="GROUP_VERTEX")
        if not is_head(settings.head):
            return
        _draw_regions(layout, settings.head)
        if settings.selected_frames:
            _draw_table(layout, settings)
        if any(
            tags.group_timestep(group.name) is not None for group in settings.head.vertex_groups
        ):
            row = layout.row(align=True)
            row.operator(ids.COUNT_SELECTED, icon="FILE_REFRESH")
            shown = has_heat_map(settings.head) and not shows_residuals(settings.head)
            text = "Hide Heat Map" if shown else "Show Heat Map"
            row.operator(
                ids.HEAT_MAP, text=text, icon="BRUSHES_ALL", depress=shown
            ).show = not shown
        else:
            layout.label(text="No selection yet")


def _draw_regions(layout: Any, head: Any) -> None:
    possible, ticked = possible_regions(head), key_regions(head)
    if not possible:
        return
    layout.label(text="Whole Regions")
    grid = layout.grid_flow(columns=2, align=True, row_major=True)
    for name in possible:
        icon = "CHECKBOX_HLT" if name in ticked else "CHECKBOX_DEHLT"
        grid.operator(
            ids.TOGGLE_REGION, text=name.replace("_", " "), icon=icon, depress=name in ticked
        ).name = name


def _draw_table(layout: Any, settings: Any) -> None:
    heading = layout.row()
    for text in ("Frame", "Triangles", "Splats"):
        heading.label(text=text)
    layout.template_list(
        SelectedFrames.bl_idname,
        "",
        settings,
        "selected_frames",
        settings,
        "selected_row",
        rows=4,
        maxrows=5,
    )
