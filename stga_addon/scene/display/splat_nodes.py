"""The geometry node tree that displays splats, without Python at playback.

For splats that follow a head it computes each triangle's frame on the head's *evaluated* mesh,
samples the frames by the splats' face index and composes position, rotation and scale.
"""

from typing import Any, NamedTuple

import bpy

from ...capture.meshes import SELECTED_WEIGHT
from .. import tags
from ..compat import NATIVE_SPLATS
from ..layers import FROZEN_COLOR
from .display_modes import (
    AS_TRAINED,
    DISPLAY_COLOR,
    LINEAR_TO_SRGB,
    MODES,
    NATIVE_GROUPS,
    SH_BANDS,
    SRGB_TO_LINEAR,
    constant_color,
    displayed,
    view_color,
)  # fmt: skip
from .frame_nodes import DEFORMED, FRAMES, PLACED, SAMPLED_STRAIN, SIGNALS, STRAIN, shifted
from .node_builder import NodeGroup, Nodes, find_tree, new_tree
from .splat_attributes import COLOR, FACE, OPACITY, RELIT_COLOR

# Inputs of the modifier, by their displayed names.
HEAD = "Head"
NEUTRAL = "Neutral"
DISPLAY = "Display"
SIZE = "Size"
OPACITY_THRESHOLD = "Opacity Threshold"
PERCENTAGE = "Percentage"
VIEW_DEPENDENT = "View-Dependent Color"
SHOW_SELECTION = "Show Selection"
SELECTED_ONLY = "Selected Only"

_FROZEN = "stga_frozen"


class TreeOptions(NamedTuple):
    """What the node tree depends on; there is one tree of each kind in a file.

    convention       of the splats' embedding ("stga", "gaussian_avatars"); None for world space
    degree           of their spherical harmonics
    strain_color     whether colors follow the strain of triangles
    offsets          driven offsets that move the splats, of `displayed_offsets`
    """

    convention: str | None
    degree: int = 0
    strain_color: bool = False
    offsets: tuple[str, ...] = ()

    @property
    def tree_name(self) -> str:
        """At most 59 characters: Blender before 5.0 has room for 63, and may add ".001"."""
        parts = [self.convention or "world", f"SH {self.degree}"]
        parts += ["color"] if self.strain_color else []
        parts += [SIGNALS[name].label for name in self.offsets]
        return f"STGA Splats ({', '.join(parts)})"


def splat_tree(options: TreeOptions) -> bpy.types.NodeTree:
    """The node tree for splats of this kind. Built once per file."""
    if (existing := find_splat_tree(options)) is not None:
        return existing
    tree = new_tree(options.tree_name)
    tree.is_modifier = True
    _add_interface(tree, options.convention is not None, options.degree)
    _build(Nodes(tree), options)
    return tree


def find_splat_tree(options: TreeOptions) -> bpy.types.NodeTree | None:
    """What `splat_tree` built before in this file, or None."""
    return find_tree(options.tree_name)


def build_next_node_group(options: TreeOptions) -> bool:
    """Build one node group that `splat_tree` needs, the tree itself last; returns False if all
    exist.

    Calling it from a timer until it returns False keeps the UI responsive meanwhile.
    """
    if find_splat_tree(options) is not None:
        return False
    convention, degree, strain_color, offsets = options
    # What `_build` uses, each after those that it uses itself.
    groups = [PLACED[convention], _RELIT, *MODES.values(), *SH_BANDS[:degree]]
    if convention is not None:
        groups += [FRAMES[convention], _FROZEN_SPLATS]
    if strain_color or offsets:
        groups += [DEFORMED, STRAIN]
    if strain_color:
        groups.append(SAMPLED_STRAIN)
    for name in offsets if convention is not None else ():
        groups += [SIGNALS[name].group, shifted(name, convention)]
    if degree > 0 or strain_color:
        groups.append(SRGB_TO_LINEAR)
    groups += [LINEAR_TO_SRGB, NATIVE_GROUPS[degree]] if NATIVE_SPLATS else []
    missing = next((group for group in groups if not group.exists()), None)
    if missing is not None:
        missing.tree()
    else:
        splat_tree(options)
    return True


def _add_interface(tree: bpy.types.NodeTree, embedded: bool, degree: int) -> None:
    def add(name: str, kind: str, description: str, **properties: Any) -> None:
        socket = tree.interface.new_socket(
            name, in_out="INPUT", socket_type=f"NodeSocket{kind}", description=description
        )
        for key, value in properties.items():
            setattr(socket, key, value)

    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    add("Geometry", "Geometry", "")
    if embedded:
        add(HEAD, "Object", "The animated head whose triangles carry the splats")
        add(NEUTRAL, "Object", "The neutral mesh that the splats were trained on")
    add(DISPLAY, "Menu", "How splats are displayed in viewports, and in images by Cycles and EEVEE")
    add(SIZE, "Float", "Factor on the splats' size", default_value=1.0, min_value=0.0)
    fraction = {"default_value": 0.0, "min_value": 0.0, "max_value": 1.0}
    add(OPACITY_THRESHOLD, "Float", "Hide splats with a lower opacity", **fraction)
    percentage = {"default_value": 100.0, "min_value": 0.0, "max_value": 100.0}
    description = "Show only a random part of the splats"
    add(PERCENTAGE, "Float", description, subtype="PERCENTAGE", **percentage)
    if degree > 0:
        description = "Colors as the scene's active camera sees them; off: their constant part"
        add(VIEW_DEPENDENT, "Bool", description, default_value=True)
    frozen = "splats that the current frame's selection freezes"
    for name, verb in ((SHOW_SELECTION, "Gray out"), (SELECTED_ONLY, "Hide")) if embedded else ():
        add(name, "Bool", f"{verb} {frozen}", default_value=False)


def _build(nodes: Nodes, options: TreeOptions) -> None:
    inputs = nodes.add("NodeGroupInput").outputs
    splats = inputs["Geometry"]
    opacity, threshold = nodes.attribute(OPACITY, "FLOAT"), inputs[OPACITY_THRESHOLD]
    opaque = nodes.compare("GREATER_EQUAL", opacity, threshold)
    # Above 0 so that 0 % shows nothing, up to 100 so that 100 % shows all.
    random = nodes.out("FunctionNodeRandomValue", {"Min": 1e-6, "Max": 100.0}, data_type="FLOAT")
    visible = nodes.logic("AND", opaque, nodes.compare("LESS_EQUAL", random, inputs[PERCENTAGE]))
    strain, gray = None, False
    if options.convention is None:
        splats = nodes.group(PLACED[None], splats)
        color = _color(nodes, inputs, None, options.degree)
    else:
        head, strained = nodes.object_info(inputs[HEAD]).outputs["Geometry"], None
        if options.strain_color or options.offsets:
            # The neutral mesh, deformed as the head is, with strain on its triangles.
            neutral = nodes.object_info(inputs[NEUTRAL], "ORIGINAL").outputs["Geometry"]
            strained = nodes.group(STRAIN, nodes.group(DEFORMED, head, neutral))
        frames = nodes.group(FRAMES[options.convention], strained if options.offsets else head)
        for name in options.offsets:
            frames = nodes.group(shifted(name, options.convention), frames)
        splats = nodes.group(PLACED[options.convention], splats, frames)
        strain = nodes.group(SAMPLED_STRAIN, strained) if options.strain_color else None
        color = _color(nodes, inputs, strain, options.degree)
        splats = nodes.store(splats, _FROZEN, nodes.group(_FROZEN_SPLATS, head), "BOOLEAN")
        frozen = nodes.attribute(_FROZEN, "BOOLEAN")
        gray = nodes.logic("AND", frozen, inputs[SHOW_SELECTION])
        color = nodes.switch("RGBA", gray, color, FROZEN_COLOR)
        visible = nodes.logic("NIMPLY", visible, nodes.logic("AND", frozen, inputs[SELECTED_ONLY]))
    splats = nodes.store(splats, DISPLAY_COLOR, nodes.group(_RELIT, color), "FLOAT_COLOR")
    native = None
    if NATIVE_SPLATS:
        view_dependent = inputs[VIEW_DEPENDENT] if options.degree > 0 else False
        fields = inputs[SIZE], constant_color(nodes, strain), view_dependent, gray
        native = nodes.group(NATIVE_GROUPS[options.degree], splats, visible, *fields)
    shown = displayed(nodes, inputs[DISPLAY], splats, visible, inputs[SIZE], native)
    nodes.finish("NodeGroupOutput", {"Geometry": shown})
    display = next(item for item in nodes.tree.interface.items_tree if item.name == DISPLAY)
    display.default_value = AS_TRAINED  # the menu has items only once it is linked


def _color(nodes: Nodes, inputs: Any, strain: Any, degree: int) -> Any:
    """Scene-linear color of each splat; strain: a vector field, None where unused."""
    color = nodes.attribute(COLOR, "FLOAT_COLOR")
    if strain is None and degree == 0:
        return color
    srgb = constant_color(nodes, strain)
    if strain is not None:
        color = nodes.group(SRGB_TO_LINEAR, srgb)
    if degree == 0:
        return color
    seen, has_camera = view_color(nodes, srgb, degree)
    is_chosen = nodes.logic("AND", inputs[VIEW_DEPENDENT], has_camera)
    return nodes.switch("RGBA", is_chosen, color, nodes.group(SRGB_TO_LINEAR, seen))


def _frozen_splats(nodes: Nodes, mesh: Any) -> bpy.types.NodeSocket:
    """Field: splats on triangles that the frame's selection, if there is one, leaves out."""
    time = nodes.add("GeometryNodeInputSceneTime").outputs["Frame"]
    frame = nodes.out("FunctionNodeValueToString", {"Value": time})
    parts = {"String": f"{tags.GROUP_PREFIX}#", "Find": "#", "Replace": frame}
    name = nodes.out("FunctionNodeReplaceString", parts)
    weight, exists = nodes.attribute_if_any(name, "FLOAT")
    selected = nodes.compare("GREATER_EQUAL", weight, SELECTED_WEIGHT)
    # On the points: a boolean is true on a face where it is true at all the face's points.
    frozen = nodes.logic("NIMPLY", exists, nodes.on_domain(selected, "BOOLEAN", "POINT"))
    return nodes.sample(mesh, frozen, nodes.attribute(FACE, "INT"), "BOOLEAN")


_FROZEN_SPLATS = NodeGroup("STGA Frozen Splats", {"Mesh": "Geometry"}, "Bool", _frozen_splats)


def _relit_color(nodes: Nodes, color: Any) -> bpy.types.NodeSocket:
    """Field: the relit color of a frame where the splats have one, else `color`."""
    relit, exists = nodes.attribute_if_any(RELIT_COLOR, "FLOAT_COLOR")
    return nodes.switch("RGBA", exists, color, relit)


_RELIT = NodeGroup("STGA Relit Color", {"Color": "Color"}, "Color", _relit_color)
