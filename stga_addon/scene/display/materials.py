"""Materials that show splats in the colors they were trained in."""

from collections.abc import Callable
from typing import Any

import bpy

from .node_builder import Nodes, new_material
from .splat_attributes import OPACITY

POINT_MATERIAL = "STGA Points"
GAUSSIAN_MATERIAL = "STGA Gaussians"
DISPLAY_COLOR = "stga_display_color"  # attribute that the splat nodes store
EXTENT = 3.0
"""Standard deviations from a quad's center to its sides; beyond, a Gaussian is below 1.2 % of its maximum."""


def point_material() -> bpy.types.Material:
    """Emits the color of a point cloud's points, with their opacity; built where the file has none."""
    # EEVEE does not sort the points of a point cloud.
    return _splat_material(POINT_MATERIAL, _point_shader, "DITHERED")


def gaussian_material() -> bpy.types.Material:
    """Renders instances of a quad as Gaussians; the instance's scale is the standard deviation.

    Along a ray with unit direction D through a point P of the quad, both in the instance's space, the
    Gaussian is densest where the ray is nearest to the center, at the squared distance |P|² − (P·D)²; its density
    there is taken for the whole splat. Exact for Cycles up to the order of overlapping splats, and for EEVEE up to
    their order by centers.
    """
    # EEVEE sorts instances: no noise. Stochastic transparency takes hundreds of samples to come as close.
    return _splat_material(GAUSSIAN_MATERIAL, _gaussian_shader, "BLENDED")


def _splat_material(name: str, build: Callable[[Nodes], Any], method: str) -> bpy.types.Material:
    """method: EEVEE's, "DITHERED" or "BLENDED"."""
    material = bpy.data.materials.get(name)
    if material is None:
        material = new_material(name, build)
        material.surface_render_method = method
        material.use_backface_culling = True
    return material


def _point_shader(nodes: Nodes) -> Any:
    return _emission(nodes, *_color_and_opacity(nodes, "GEOMETRY"))


def _gaussian_shader(nodes: Nodes) -> Any:
    color, opacity = _color_and_opacity(nodes, "INSTANCER")
    geometry = nodes.add("ShaderNodeNewGeometry").outputs
    position = nodes.add("ShaderNodeTexCoord").outputs["Object"]
    incoming = {"Vector": geometry["Incoming"]}
    ray = nodes.out(
        "ShaderNodeVectorTransform", incoming, vector_type="VECTOR", convert_from="WORLD", convert_to="OBJECT"
    )
    along = nodes.vector("DOT_PRODUCT", position, nodes.vector("NORMALIZE", ray))
    length2 = nodes.vector("DOT_PRODUCT", position, position)
    distance2 = nodes.math("SUBTRACT", length2, nodes.math("MULTIPLY", along, along))
    density = nodes.math("EXPONENT", nodes.math("MULTIPLY", distance2, -0.5))
    # Whatever is behind a quad sees through it.
    front = nodes.math("SUBTRACT", 1.0, geometry["Backfacing"])
    return _emission(nodes, color, nodes.math("MULTIPLY", nodes.math("MULTIPLY", density, front), opacity))


def _color_and_opacity(nodes: Nodes, attribute_type: str) -> tuple[Any, Any]:
    """What the splat nodes stored on points ("GEOMETRY") or instances ("INSTANCER")."""
    color, opacity = (
        nodes.add("ShaderNodeAttribute", attribute_type=attribute_type, attribute_name=name).outputs
        for name in (DISPLAY_COLOR, OPACITY)
    )
    return color["Color"], opacity["Fac"]


def _emission(nodes: Nodes, color: Any, alpha: Any) -> Any:
    transparent, emission = nodes.out("ShaderNodeBsdfTransparent"), nodes.out("ShaderNodeEmission", {"Color": color})
    return nodes.out("ShaderNodeMixShader", {"Fac": alpha, "Shader": [transparent, emission]})
