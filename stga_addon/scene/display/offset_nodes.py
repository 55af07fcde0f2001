"""Node groups that move the frames of triangles by driven offsets (`avatar.offsets`)."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

from .frame_nodes import shifted_frames
from .node_builder import NodeGroup, Nodes
from .splat_attributes import DRIVEN_OFFSET
from .strain_nodes import SMOOTHED, SMOOTHED_STRAIN


@dataclass(frozen=True)
class SignalNodes:
    """How nodes compute the signal of a driven offset, of three components at most.

    label      in names of node trees, short
    group      the mesh from STRAIN -> the same with the signal stored on its faces
    attribute  the vector that is stored
    """

    label: str
    group: NodeGroup
    attribute: str


SIGNALS = {"strain_position": SignalNodes("position", SMOOTHED, SMOOTHED_STRAIN)}
"""Driven offset -> its signal; those without are displayed as trained only."""


def displayed_offsets(names: Collection[str]) -> tuple[str, ...]:
    """Those of the driven offsets that nodes display, in the order of SIGNALS."""
    return tuple(name for name in SIGNALS if name in names)


@cache
def shifted(offset: str, convention: str) -> NodeGroup:
    """The group that moves frames by an offset: a mesh from STRAIN with FRAMES to the same mesh."""
    name = f"STGA Driven Offset ({SIGNALS[offset].label}, {convention})"
    return NodeGroup(name, {"Frames": "Geometry"}, "Geometry", partial(_shifted, offset, convention))


def _shifted(offset: str, convention: str, nodes: Nodes, mesh: Any) -> Any:
    mesh = nodes.group(SIGNALS[offset].group, mesh)
    signal = nodes.components(nodes.attribute(SIGNALS[offset].attribute, "FLOAT_VECTOR"))
    terms = (
        nodes.scale(nodes.attribute(DRIVEN_OFFSET.format(offset, index), "FLOAT_VECTOR"), factor)
        for index, factor in enumerate(signal)
    )
    return shifted_frames(nodes, mesh, nodes.sum(*terms), convention)
