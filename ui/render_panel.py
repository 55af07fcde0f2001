"""Render properties of the engine STGA Splats."""

from typing import Any

import bpy

from ..operators.environment import has_runtime
from ..stga_addon.raster.render_client import missing_packages
from ..stga_addon.scene.render.engine import ENGINE


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
        layout.use_property_split = True
        layout.prop(context.scene.render, "film_transparent", text="Transparent Film")
        layout.prop(context.view_layer, "use_pass_z", text="Depth Pass")
        if missing_packages():
            drawn_by = "Drawn by the training runtime" if has_runtime(context) else "Nothing here can draw"
            layout.label(text=f"{drawn_by}: Blender's Python lacks {', '.join(missing_packages())}", icon="INFO")
