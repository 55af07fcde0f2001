"""Base of the panels in the sidebar tab."""

from ..operators import ids


class SidebarPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = ids.TAB
