"""Shares of selection, or errors of the avatar, by triangle as colors on the head."""

from typing import Any

import bpy
import numpy as np

from ..arrays import flat_floats
from .node_builder import Nodes, new_material
from .splat_attributes import with_alpha, write_attributes

SHARE = "stga_selected_share"  # on faces: fraction of the frames that select them
RESIDUAL = "stga_residual"  # on faces: mean absolute error (0…1) of what their splats show
HEAT = "stga_heat"  # on face corners: one of these as a color, relative to the largest
MODIFIER = "STGA Heat Map"
# Linear RGB from never to most often selected.
STOPS = (0.0, 1e-9, 0.25, 0.5, 0.75, 1.0)
COLORS = (
    (0.1, 0.1, 0.1),
    (0.02, 0.03, 0.3),
    (0.05, 0.35, 0.6),
    (0.15, 0.6, 0.1),
    (0.95, 0.6, 0.02),
    (0.9, 0.05, 0.01),
)


def show_heat_map(
    head: Any, values: np.ndarray, attribute: str = SHARE, largest: float | None = None
) -> None:
    """Color the head's triangles by values (F,) from 0 to `largest` (None: the largest value).

    Its own materials stay: a modifier assigns the heat map's. The colors are the active color
    attribute, for solid shading, and a material, for EEVEE and Cycles. attribute: SHARE or
    RESIDUAL, in which the values are stored.
    """
    hide_heat_map(head)
    whole = values.max(initial=0.0) if largest is None else largest
    scaled = np.minimum(values / max(whole, 1e-9), 1.0)
    channels = [np.interp(scaled, STOPS, channel) for channel in zip(*COLORS, strict=True)]
    colors = flat_floats(np.repeat(with_alpha(np.column_stack(channels)), 3, axis=0))
    write_attributes(head.data, {attribute: ("FLOAT", "value", flat_floats(values))}, "FACE")
    write_attributes(head.data, {HEAT: ("FLOAT_COLOR", "color", colors)}, "CORNER")
    head.data.attributes.active_color_name = HEAT
    tree = bpy.data.node_groups.get(MODIFIER)
    if tree is None:  # it assigns the heat map's material
        tree = bpy.data.node_groups.new(MODIFIER, "GeometryNodeTree")
        tree.is_modifier = True
        for side in ("INPUT", "OUTPUT"):
            tree.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
        nodes = Nodes(tree)
        inputs = {"Geometry": nodes.out("NodeGroupInput")}
        inputs["Material"] = new_material(MODIFIER, _unlit)
        colored = nodes.out("GeometryNodeSetMaterial", inputs)
        nodes.finish("NodeGroupOutput", {"Geometry": colored})
    head.modifiers.new(MODIFIER, "NODES").node_group = tree


def hide_heat_map(head: Any) -> None:
    """Show the head as it was before `show_heat_map`."""
    for modifier in [old for old in head.modifiers if old.name.startswith(MODIFIER)]:
        head.modifiers.remove(modifier)
    for name in (SHARE, RESIDUAL, HEAT):
        if name in head.data.attributes:
            head.data.attributes.remove(head.data.attributes[name])


def has_heat_map(head: Any) -> bool:
    return MODIFIER in head.modifiers


def shows_residuals(head: Any) -> bool:
    return has_heat_map(head) and RESIDUAL in head.data.attributes


def _unlit(nodes: Nodes) -> Any:
    color = nodes.add("ShaderNodeAttribute", attribute_name=HEAT).outputs["Color"]
    return nodes.out("ShaderNodeEmission", {"Color": color})
