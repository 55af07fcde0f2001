"""Materials that show splats in the colours they were trained in."""

from typing import Any

import bpy

POINT_MATERIAL = "STGA Points"
ELLIPSOID_MATERIAL = "STGA Ellipsoids"
DISPLAY_COLOR = "stga_display_color"
OPACITY = "stga_opacity"


def splat_material(name: str, attribute_type: str) -> bpy.types.Material:
    """The material `name`: emits the splats' colour with their opacity; made where the file has none.

    attribute_type: where the shader finds the attributes, "GEOMETRY" (points) or "INSTANCER" (instances).
    """
    material = bpy.data.materials.get(name)
    if material is not None:
        return material
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # Blender 4: a new material has no tree
        material.use_nodes = True
    # Hashed transparency needs no sorting, which tens of thousands of overlapping splats would not survive.
    material.surface_render_method = "DITHERED"
    material.use_backface_culling = True
    _build(material.node_tree, attribute_type)
    return material


def view_transform_hint(scene: bpy.types.Scene) -> str | None:
    """One sentence where the scene's view transform changes the colours that the splats were trained in."""
    if scene.view_settings.view_transform == "Standard":
        return None
    return f"View transform {scene.view_settings.view_transform} changes the splats' colours: choose Standard."


def _build(tree: Any, attribute_type: str) -> None:
    tree.nodes.clear()

    def add(kind: str, x: float, y: float = 0.0) -> Any:
        node = tree.nodes.new(kind)
        node.location = (x, y)
        return node

    color, opacity = add("ShaderNodeAttribute", -400), add("ShaderNodeAttribute", -400, -200)
    color.attribute_type, color.attribute_name = attribute_type, DISPLAY_COLOR
    opacity.attribute_type, opacity.attribute_name = attribute_type, OPACITY
    clear, glow, mix = (
        add("ShaderNodeBsdfTransparent", -150, 150),
        add("ShaderNodeEmission", -150),
        add("ShaderNodeMixShader", 50),
    )
    output = add("ShaderNodeOutputMaterial", 250)
    tree.links.new(color.outputs["Color"], glow.inputs["Color"])
    tree.links.new(opacity.outputs["Fac"], mix.inputs[0])
    tree.links.new(clear.outputs[0], mix.inputs[1])
    tree.links.new(glow.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
