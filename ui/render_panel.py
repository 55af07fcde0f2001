"""Render properties of the engine STGA Splats."""

from typing import Any

import bpy

from ..operators.training_python import has_training_python
from ..stga_addon.render.client import missing_packages
from ..stga_addon.scene.gpu.renderer import has_gpu_context
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
        if missing_packages() and not has_gpu_context():
            renderer = (
                "Rendered by another Python"
                if has_training_python(context)
                else "No Python here can render"
            )
            layout.label(
                text=f"{renderer}: Blender's Python lacks {', '.join(missing_packages())}",
                icon="INFO",
            )
