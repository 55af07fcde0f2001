"""How often each triangle is selected, as colours on the head."""

from typing import Any

import bpy
import numpy as np

SHARE = "stga_selected_share"  # on faces: 0 to 1 of the frames
HEAT = "stga_heat"  # the same as a colour on face corners, the brightest for what is selected most
MODIFIER = "STGA Heat Map"
# Never to most often; linear red, green, blue.
STOPS = (0.0, 1e-9, 0.25, 0.5, 0.75, 1.0)
COLOURS = (
    (0.1, 0.1, 0.1),
    (0.02, 0.03, 0.3),
    (0.05, 0.35, 0.6),
    (0.15, 0.6, 0.1),
    (0.95, 0.6, 0.02),
    (0.9, 0.05, 0.01),
)


def show_heat_map(head: Any, share: np.ndarray) -> None:
    """Colour the head's triangles by share (F,), leaving its own materials alone: a modifier puts the colours on.

    They are the active colour attribute, for solid mode, and a material, for EEVEE and Cycles.
    """
    hide_heat_map(head)
    mesh = head.data
    _attribute(mesh, SHARE, "FLOAT", "FACE", "value", share)
    scaled = share / max(share.max(initial=0.0), 1e-9)
    channels = [np.interp(scaled, STOPS, channel) for channel in zip(*COLOURS, strict=True)]
    colours = np.column_stack([*channels, np.ones(len(share))])
    _attribute(mesh, HEAT, "FLOAT_COLOR", "CORNER", "color", np.repeat(colours, 3, axis=0))
    mesh.attributes.active_color_name = HEAT
    head.modifiers.new(MODIFIER, "NODES").node_group = _tree()


def hide_heat_map(head: Any) -> None:
    """Show the head as it was before `show_heat_map`."""
    for modifier in [old for old in head.modifiers if old.name.startswith(MODIFIER)]:
        head.modifiers.remove(modifier)
    for name in (SHARE, HEAT):
        if name in head.data.attributes:
            head.data.attributes.remove(head.data.attributes[name])


def has_heat_map(head: Any) -> bool:
    return MODIFIER in head.modifiers


def _attribute(mesh: Any, name: str, kind: str, domain: str, field: str, values: np.ndarray) -> None:
    mesh.attributes.new(name, kind, domain).data.foreach_set(field, np.ascontiguousarray(values, np.float32).ravel())


def _tree() -> Any:
    """Geometry → the same with the heat map's material."""
    if MODIFIER in bpy.data.node_groups:
        return bpy.data.node_groups[MODIFIER]
    tree = bpy.data.node_groups.new(MODIFIER, "GeometryNodeTree")
    tree.is_modifier = True
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeSetMaterial", "NodeGroupOutput")
    given, coloured, shown = (tree.nodes.new(kind) for kind in kinds)
    coloured.inputs["Material"].default_value = _material()
    tree.links.new(given.outputs[0], coloured.inputs["Geometry"])
    tree.links.new(coloured.outputs[0], shown.inputs[0])
    for column, node in enumerate((given, coloured, shown)):
        node.location = (220 * column, 0)
    return tree


def _material() -> Any:
    """The colours as they are, in any light."""
    material = bpy.data.materials.new(MODIFIER)
    if material.node_tree is None:  # Blender 4: a new material has no tree
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    kinds = ("ShaderNodeAttribute", "ShaderNodeEmission", "ShaderNodeOutputMaterial")
    colour, glow, output = (tree.nodes.new(kind) for kind in kinds)
    colour.attribute_name = HEAT
    tree.links.new(colour.outputs["Color"], glow.inputs["Color"])
    tree.links.new(glow.outputs[0], output.inputs["Surface"])
    for column, node in enumerate((colour, glow, output)):
        node.location = (220 * column, 0)
    return material
