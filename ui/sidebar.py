"""Base of the panels in the sidebar tab."""


class SidebarPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "STGA"
