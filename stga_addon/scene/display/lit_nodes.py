"""Native splats in the scene's light: a surface of albedo with the head's normals, and a shrunken
mesh that throws the shadows."""

from typing import Any

from . import splat_attributes as stored
from .node_builder import NodeGroup, Nodes, Socket, kept_material

RECORDED = "Recorded"
"""Light in which native splats keep the colors of the images that they were trained on."""
SCENE_LIGHT = "Scene Light"
"""Light of the Blender scene on the splats' albedo."""
LIGHTS = {
    RECORDED: "Native splats shine in the colors of the capture",
    SCENE_LIGHT: "Native splats are lit by the scene's lights and world, and shadowed",
}
"""Light of native splats in EEVEE and Cycles -> its description."""
ALBEDO = "albedo"
"""Attribute of native splats; roughness is its fourth channel."""
NORMAL = "surface_normal"
"""Attribute of native splats: smooth normal of the head's mesh, in object space."""
SHRINKAGE_M = 0.006
"""Depth of the shadow-casting mesh below the head's mesh: splats would lie in the shadow of the
latter."""
FOLD_M = 0.03
"""Skin that sees other skin within this, as in mouth, nostrils and between lids, throws none: below
its surface is the other one."""
LIFT_M = 1e-4
TRANSLUCENT_FRACTION = 1e-3


def _surface(nodes: Nodes, splats: Any, head: Any) -> Socket:
    """Splats with what they are lit by; without a known light, colors are taken for albedo."""
    albedo, is_known = nodes.attribute_if_any(stored.ALBEDO, "FLOAT_COLOR")
    color = nodes.attribute(stored.DISPLAY_COLOR, "FLOAT_COLOR")
    color = nodes.switch("RGBA", is_known, color, albedo)
    splats = nodes.store(splats, ALBEDO, color, "FLOAT_COLOR")
    smooth = nodes.at_points(nodes.out("GeometryNodeInputNormal"), "FLOAT_VECTOR")
    face = nodes.attribute(stored.FACE, "INT")
    normal = nodes.sample(head, smooth, face, "FLOAT_VECTOR")
    return nodes.store(splats, NORMAL, normal, "FLOAT_VECTOR")


def _lit(nodes: Nodes, splats: Any, head: Any) -> Socket:
    """Native splats with their material, and the mesh that throws shadows."""
    material = kept_material("STGA Lit Splats", _lit_shader, "DITHERED")
    if cycles := getattr(material, "cycles", None):
        # it takes light from normals that differ from the ellipsoids'
        cycles.use_bump_map_correction = False
    lit = nodes.out("GeometryNodeSetMaterial", {"Geometry": splats, "Material": material})
    position = nodes.out("GeometryNodeInputPosition")
    normal = nodes.out("GeometryNodeInputNormal")
    start = nodes.vector("ADD", position, nodes.scale(normal, LIFT_M))
    ray = {"Source Position": start, "Ray Direction": normal, "Ray Length": FOLD_M}
    is_fold = nodes.add("GeometryNodeRaycast", {"Target Geometry": head, **ray}).outputs["Is Hit"]
    open_skin = nodes.out("GeometryNodeDeleteGeometry", {"Geometry": head, "Selection": is_fold})
    inward = {"Geometry": open_skin, "Offset": nodes.scale(normal, -SHRINKAGE_M)}
    caster = nodes.out("GeometryNodeSetPosition", inward)
    material = kept_material("STGA Shadow", _shadow_shader, "DITHERED")
    caster = nodes.out("GeometryNodeSetMaterial", {"Geometry": caster, "Material": material})
    both = nodes.add("GeometryNodeJoinGeometry")
    for part in (lit, caster):
        nodes.tree.links.new(part, both.inputs["Geometry"])
    return both.outputs["Geometry"]


def _lit_shader(nodes: Nodes) -> Any:
    """Skin of the splats' albedo, which throws no shadow: on itself, it would be blotches."""
    albedo = nodes.add("ShaderNodeAttribute", attribute_name=ALBEDO).outputs
    normal = nodes.add("ShaderNodeAttribute", attribute_name=NORMAL).outputs["Vector"]
    to_world = {"vector_type": "NORMAL", "convert_from": "OBJECT", "convert_to": "WORLD"}
    normal = nodes.out("ShaderNodeVectorTransform", {"Vector": normal}, **to_world)
    surface = {"Base Color": albedo["Color"], "Roughness": albedo["Alpha"], "Normal": normal}
    skin = nodes.out("ShaderNodeBsdfPrincipled", surface)
    # Else Cycles' light tree leaves out lamps behind an ellipsoid, if not behind the mesh.
    shaders = [skin, nodes.out("ShaderNodeBsdfTranslucent")]
    lit = nodes.out("ShaderNodeMixShader", {"Fac": TRANSLUCENT_FRACTION, "Shader": shaders})
    return _by_shadow(nodes, lit, None)


def _shadow_shader(nodes: Nodes) -> Any:
    """Seen by nothing but light."""
    return _by_shadow(nodes, None, nodes.out("ShaderNodeBsdfDiffuse"))


def _by_shadow(nodes: Nodes, visible: Any, shadow: Any) -> Any:
    """One shader for rays to lights and one for all others; None: these pass."""
    is_shadow = nodes.add("ShaderNodeLightPath").outputs["Is Shadow Ray"]
    shaders = [each or nodes.out("ShaderNodeBsdfTransparent") for each in (visible, shadow)]
    return nodes.out("ShaderNodeMixShader", {"Fac": is_shadow, "Shader": shaders})


_INPUTS = {"Splats": "Geometry", "Head": "Geometry"}
SURFACE = NodeGroup("STGA Lit Surface", _INPUTS, "Geometry", _surface)
LIT = NodeGroup("STGA Scene Light", _INPUTS, "Geometry", _lit)
