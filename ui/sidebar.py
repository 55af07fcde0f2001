"""What the panels of the sidebar tab have in common."""


class SidebarPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "STGA"
