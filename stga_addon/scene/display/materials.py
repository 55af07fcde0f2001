"""Materials that show splats in the colours they were trained in."""

from collections.abc import Callable
from typing import Any

import bpy

POINT_MATERIAL = "STGA Points"
ELLIPSOID_MATERIAL = "STGA Ellipsoids"
DISPLAY_COLOR = "stga_display_color"
OPACITY = "stga_opacity"
EXTENT = 3.0
"""Standard deviations from an ellipsoid's centre to its surface: beyond, a Gaussian is fainter than 1.2 %."""


def point_material() -> bpy.types.Material:
    """Emits the colour of a point cloud's points with their opacity; made where the file has none."""
    return _material(POINT_MATERIAL, _build_points)


def ellipsoid_material() -> bpy.types.Material:
    """Draws instances of a sphere of radius EXTENT as Gaussians; the instance's scale is the standard deviation.

    Along a ray with unit direction D through a surface point P of the sphere, both in the instance's space, the
    Gaussian is densest where the ray is nearest to the centre, at the squared distance |P|² − (P·D)²; its density
    there stands for the whole splat. Exact for Cycles up to the order of overlapping splats, noisy in EEVEE, which
    draws transparency by chance.
    """
    return _material(ELLIPSOID_MATERIAL, _build_ellipsoids)


def _material(name: str, build: Callable[[Any], None]) -> bpy.types.Material:
    material = bpy.data.materials.get(name)
    if material is not None:
        return material
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # Blender 4: a new material has no tree
        material.use_nodes = True
    # Hashed transparency needs no sorting, which tens of thousands of overlapping splats would not survive.
    material.surface_render_method = "DITHERED"
    material.use_backface_culling = True
    material.node_tree.nodes.clear()
    build(material.node_tree)
    return material


def _build_points(tree: Any) -> None:
    color, opacity = _attributes(tree, "GEOMETRY")
    _glow(tree, color, opacity)


def _build_ellipsoids(tree: Any) -> None:
    color, opacity = _attributes(tree, "INSTANCER")
    geometry = _node(tree, "ShaderNodeNewGeometry", -1200, -300)
    position = _node(tree, "ShaderNodeTexCoord", -1200, -600).outputs["Object"]
    ray = _node(tree, "ShaderNodeVectorTransform", -1000, -300)
    ray.vector_type, ray.convert_from, ray.convert_to = "VECTOR", "WORLD", "OBJECT"
    tree.links.new(geometry.outputs["Incoming"], ray.inputs[0])
    direction = _vector(tree, "NORMALIZE", -800, ray.outputs[0])
    along = _vector(tree, "DOT_PRODUCT", -600, position, direction)
    length2 = _vector(tree, "DOT_PRODUCT", -600, position, position)
    distance2 = _math(tree, "SUBTRACT", -200, length2, _math(tree, "MULTIPLY", -400, along, along))
    density = _math(tree, "EXPONENT", 200, _math(tree, "MULTIPLY", 0, distance2, -0.5))
    # A ray leaves every sphere it enters: only the front counts.
    front = _math(tree, "SUBTRACT", 0, 1.0, geometry.outputs["Backfacing"])
    alpha = _math(tree, "MULTIPLY", 600, _math(tree, "MULTIPLY", 400, density, front), opacity)
    _glow(tree, color, alpha)


def _attributes(tree: Any, kind: str) -> tuple[Any, Any]:
    """The colour and opacity that the splats' node tree stores; kind "GEOMETRY" (points) or "INSTANCER" (instances)."""
    color, opacity = _node(tree, "ShaderNodeAttribute", 400, 300), _node(tree, "ShaderNodeAttribute", 400, 100)
    color.attribute_type, color.attribute_name = kind, DISPLAY_COLOR
    opacity.attribute_type, opacity.attribute_name = kind, OPACITY
    return color.outputs["Color"], opacity.outputs["Fac"]


def _glow(tree: Any, color: Any, alpha: Any) -> None:
    clear, glow = _node(tree, "ShaderNodeBsdfTransparent", 800, 150), _node(tree, "ShaderNodeEmission", 800)
    mix, output = _node(tree, "ShaderNodeMixShader", 1000), _node(tree, "ShaderNodeOutputMaterial", 1200)
    tree.links.new(color, glow.inputs["Color"])
    tree.links.new(alpha, mix.inputs[0])
    tree.links.new(clear.outputs[0], mix.inputs[1])
    tree.links.new(glow.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])


def _math(tree: Any, operation: str, x: float, *values: Any) -> Any:
    return _operation(tree, "ShaderNodeMath", operation, x, values)


def _vector(tree: Any, operation: str, x: float, *values: Any) -> Any:
    return _operation(tree, "ShaderNodeVectorMath", operation, x, values)


def _operation(tree: Any, kind: str, operation: str, x: float, values: Any) -> Any:
    node = _node(tree, kind, x, -300)
    node.operation = operation
    for socket, value in zip(node.inputs, values, strict=False):  # unused inputs follow the used ones
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return next(socket for socket in node.outputs if socket.enabled)


def _node(tree: Any, kind: str, x: float, y: float = 0.0) -> Any:
    node = tree.nodes.new(kind)
    node.location = (x, y)
    return node
