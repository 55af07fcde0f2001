"""The geometry-node trees that make splats follow a mesh, without any Python at run time.

The splat object is a mesh of loose vertices, one per splat, whose attributes hold the trained values in the
frame of a triangle. The tree computes every triangle's frame on the head's *evaluated* mesh, samples the
frames by the splats' face index and composes position, rotation and scale.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import bpy

from ...avatar.embedding import SLIVER, UPRIGHT
from .. import tags
from .color_nodes import BANDS, DEFORMED, FACE, SCENE_LINEAR, STRAIN, constant, seen_from, view_direction
from .display_modes import PARTS, POINTS, WORLD_ROTATION, WORLD_SCALE, shown_as
from .materials import DISPLAY_COLOR, OPACITY
from .node_builder import Nodes, Part, lay_out, made_tree, new_tree

# Attributes of the splat object that are read here; the others stand in `node_colors` and `materials`.
XYZ = "stga_xyz"
ROTATION = "stga_rotation"
SCALE = "stga_scale"
COLOR = "stga_color"  # the constant part, scene-linear: what most frames of most avatars show, without a calculation
NEUTRAL_AREA = "stga_neutral_area"

# Inputs of the modifier, by the name a person sees.
HEAD = "Head"
NEUTRAL = "Neutral"
DISPLAY = "Display"
SIZE = "Size"
OPACITY_THRESHOLD = "Opacity Threshold"
PERCENTAGE = "Percentage"
VIEW_DEPENDENT = "View-Dependent Colour"
SHOW_SELECTION = "Show Selection"
SELECTED_ONLY = "Selected Only"

FROZEN_GREY = (0.25, 0.25, 0.25, 1.0)

_FROZEN = "stga_frozen"
_FRAME_ORIGIN, _FRAME_ROTATION, _FRAME_SIZE = "stga_frame_origin", "stga_frame_rotation", "stga_frame_size"


def splat_tree(convention: str | None, degree: int = 0, strained: bool = False) -> bpy.types.NodeTree:
    """The node tree for splats embedded by `convention` ("stga", "gaussian_avatars"), or None for world space.

    degree: of their spherical harmonics; strained: whether their colours follow strain. Built once per file.
    """
    made = find_splat_tree(convention, degree, strained)
    if made is not None:
        return made
    tree = new_tree(_name(convention, degree, strained))
    tree.is_modifier = True
    _declare(tree, convention is not None, degree)
    _build(Nodes(tree), convention, degree, strained)
    return tree


def find_splat_tree(convention: str | None, degree: int, strained: bool) -> bpy.types.NodeTree | None:
    """What `splat_tree` built before in this file, or None."""
    return made_tree(_name(convention, degree, strained))


def build_next_node_group(convention: str | None, degree: int, strained: bool) -> bool:
    """Build one thing that `splat_tree` needs and the file has not got yet, the tree itself last; whether one was left.

    Where Blender is to go on in between, call it until it answers False.
    """
    if find_splat_tree(convention, degree, strained) is not None:
        return False
    missing = next((part for part in _parts(convention, degree, strained) if not part.is_made()), None)
    if missing is not None:
        missing.tree()
    else:
        splat_tree(convention, degree, strained)
    return True


def _parts(convention: str | None, degree: int, strained: bool) -> list[Part]:
    """What `_build` makes the tree of."""
    parts = [_PLACED[convention], *PARTS.values(), *BANDS[:degree]]
    if convention is not None:
        parts += [_FRAMED[convention], _FROZEN_BY]
    if degree > 0 or strained:
        parts.append(SCENE_LINEAR)
    return parts + ([DEFORMED, STRAIN] if strained else [])


def _name(convention: str | None, degree: int, strained: bool) -> str:
    return f"STGA Splats ({convention or 'world'}, SH {degree}{', strain' if strained else ''})"


def _declare(tree: bpy.types.NodeTree, embedded: bool, degree: int) -> None:
    def add(name: str, kind: str, default: Any = None, low: float | None = None, high: float | None = None) -> Any:
        socket = tree.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
        if default is not None:
            socket.default_value = default
        if low is not None:
            socket.min_value = low
        if high is not None:
            socket.max_value = high
        return socket

    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    add("Geometry", "Geometry")
    if embedded:
        add(HEAD, "Object").description = "The animated head whose triangles carry the splats"
        add(NEUTRAL, "Object").description = "The neutral mesh that the splats were trained on"
    add(DISPLAY, "Menu").description = "What stands for a splat; the STGA Splats render engine draws splats themselves"
    add(SIZE, "Float", 1.0, 0.0).description = "Factor on the splats' size"
    add(OPACITY_THRESHOLD, "Float", 0.0, 0.0, 1.0).description = "Hide splats that are fainter than this"
    percentage = add(PERCENTAGE, "Float", 100.0, 0.0, 100.0)
    percentage.subtype = "PERCENTAGE"
    percentage.description = "Show only a random part of the splats"
    if degree > 0:
        colour = add(VIEW_DEPENDENT, "Bool", True)
        colour.description = "Colours as the scene's active camera sees them; off: their constant part"
    if embedded:
        selection = add(SHOW_SELECTION, "Bool", False)
        selection.description = "Turn grey what the current frame's selection freezes"
        only = add(SELECTED_ONLY, "Bool", False)
        only.description = "Hide what the current frame's selection freezes"


def _build(nodes: Nodes, convention: str | None, degree: int, strained: bool) -> None:
    inputs = nodes.tree.nodes.new("NodeGroupInput").outputs
    splats, strain, meshes = inputs["Geometry"], None, []
    if convention is not None:
        mesh = nodes.object(inputs[HEAD]).outputs["Geometry"]
        meshes = [nodes.part(_FRAMED[convention], mesh)]
        if strained:
            neutral = nodes.object(inputs[NEUTRAL], "ORIGINAL").outputs["Geometry"]
            strain = nodes.part(STRAIN, nodes.part(DEFORMED, mesh, neutral))
    splats = nodes.part(_PLACED[convention], splats, *meshes)
    color = nodes.attribute(COLOR, "FLOAT_COLOR")
    if strained or degree > 0:
        constant_color = constant(nodes, strain)
    if strained:
        color = nodes.part(SCENE_LINEAR, constant_color)
    if degree > 0:
        direction, has_camera = view_direction(nodes, nodes.out("GeometryNodeInputPosition"))
        seen = nodes.part(SCENE_LINEAR, seen_from(nodes, constant_color, degree, direction))
        color = nodes.switch("RGBA", nodes.logic("AND", inputs[VIEW_DEPENDENT], has_camera), color, seen)
    visible = _visible(nodes, inputs)
    if convention is not None:
        splats = nodes.store(splats, _FROZEN, nodes.part(_FROZEN_BY, mesh), "BOOLEAN")
        frozen = nodes.attribute(_FROZEN, "BOOLEAN")
        color = nodes.switch("RGBA", nodes.logic("AND", frozen, inputs[SHOW_SELECTION]), color, FROZEN_GREY)
        visible = nodes.logic("NIMPLY", visible, nodes.logic("AND", frozen, inputs[SELECTED_ONLY]))
    splats = nodes.store(splats, DISPLAY_COLOR, color, "FLOAT_COLOR")
    shown = shown_as(nodes, inputs[DISPLAY], splats, visible, inputs[SIZE])
    output = nodes.tree.nodes.new("NodeGroupOutput")
    nodes.tree.links.new(shown, output.inputs["Geometry"])
    display = next(item for item in nodes.tree.interface.items_tree if item.name == DISPLAY)
    display.default_value = POINTS  # only now: before, the menu has no items
    lay_out(nodes.tree)


def _visible(nodes: Nodes, inputs: Any) -> bpy.types.NodeSocket:
    """Which splats are displayed: opaque enough, and in the random part."""
    opaque = nodes.compare("GREATER_EQUAL", nodes.attribute(OPACITY, "FLOAT"), inputs[OPACITY_THRESHOLD])
    # Above 0 so that 0 % shows nothing, up to 100 so that 100 % shows all.
    draw = nodes.out("FunctionNodeRandomValue", {"Min": 1e-6, "Max": 100.0}, data_type="FLOAT")
    return nodes.logic("AND", opaque, nodes.compare("LESS_EQUAL", draw, inputs[PERCENTAGE]))


def _framed(convention: str, nodes: Nodes, mesh: Any) -> Any:
    """The mesh with each triangle's frame (`avatar.embedding.face_frames` as nodes)."""
    # Stored on the mesh first: sampling a stored attribute is cheap, sampling a field computes it again.
    place = nodes.out("GeometryNodeInputPosition")
    origin, turn, size = _FRAMES[convention](nodes, *(nodes.at(place, nodes.corner(index)) for index in range(3)))
    mesh = nodes.store(mesh, _FRAME_ORIGIN, origin, "FLOAT_VECTOR", "FACE")
    mesh = nodes.store(mesh, _FRAME_ROTATION, turn, "QUATERNION", "FACE")
    return nodes.store(mesh, _FRAME_SIZE, size, "FLOAT", "FACE")


def _placed(convention: str | None, nodes: Nodes, splats: Any, mesh: Any = None) -> Any:
    """The splats where they are in the object's space, with their rotation and scale there; mesh: from `_framed`."""
    xyz = nodes.attribute(XYZ, "FLOAT_VECTOR")
    rotation = nodes.attribute(ROTATION, "QUATERNION")
    scale = nodes.attribute(SCALE, "FLOAT_VECTOR")
    if convention is not None:
        origin, turn, size = _sampled_frames(nodes, mesh, convention)
        xyz = nodes.out("FunctionNodeRotateVector", {"Vector": nodes.scaled(xyz, size), "Rotation": turn})
        xyz = nodes.vector("ADD", xyz, origin)
        rotation = nodes.out(
            "FunctionNodeRotateRotation", {"Rotation": rotation, "Rotate By": turn}, rotation_space="GLOBAL"
        )
        scale = nodes.scaled(scale, size)
    splats = nodes.out("GeometryNodeSetPosition", {"Geometry": splats, "Position": xyz})
    splats = nodes.store(splats, WORLD_ROTATION, rotation, "QUATERNION")
    return nodes.store(splats, WORLD_SCALE, scale, "FLOAT_VECTOR")


def _sampled_frames(nodes: Nodes, mesh: Any, convention: str) -> tuple[Any, Any, Any]:
    """Origin, rotation and scale of each splat's triangle."""
    face = nodes.attribute(FACE, "INT")

    def sample(name: str, kind: str) -> Any:
        return nodes.sample(mesh, nodes.attribute(name, kind), face, kind)

    size = sample(_FRAME_SIZE, "FLOAT")
    if convention == "stga":
        neutral = nodes.attribute(NEUTRAL_AREA, "FLOAT")
        ratio = nodes.math("SQRT", nodes.math("DIVIDE", size, neutral))
        # No neutral area, no meaningful ratio: the local metres stay as they are.
        size = nodes.switch("FLOAT", nodes.compare("GREATER_THAN", neutral, 0.0), 1.0, ratio)
    return sample(_FRAME_ORIGIN, "FLOAT_VECTOR"), sample(_FRAME_ROTATION, "QUATERNION"), size


def _stga_frames(nodes: Nodes, p0: Any, p1: Any, p2: Any) -> tuple[Any, Any, Any]:
    """Centroid; axes [n(p0−o), ·, normal]; the triangle's area (its ratio to the neutral area is the square of k)."""
    origin = nodes.scaled(nodes.plus(p0, p1, p2), 1 / 3)
    edge, side = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
    # p0 − origin without the origin, which rounds: it must vanish where the corners coincide.
    first = nodes.scaled(nodes.vector("ADD", edge, side), -1 / 3)
    turn, normal, _ = _axes_to_rotation(nodes, first, edge, side, "Z")
    return origin, turn, nodes.math("MULTIPLY", nodes.vector("LENGTH", normal), 0.5)


def _gaussian_avatars_frames(nodes: Nodes, p0: Any, p1: Any, p2: Any) -> tuple[Any, Any, Any]:
    """Centroid; axes [n(p1−p0), normal, ·]; mean of the first edge and the height over it."""
    origin = nodes.scaled(nodes.plus(p0, p1, p2), 1 / 3)
    edge, side = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
    turn, normal, no_edge = _axes_to_rotation(nodes, edge, edge, side, "Y")
    # Height over the edge = |edge × side| / |edge|, or the side where the edge has no length.
    length = nodes.vector("LENGTH", edge)
    height = nodes.math("DIVIDE", nodes.vector("LENGTH", normal), length)
    height = nodes.switch("FLOAT", no_edge, height, nodes.vector("LENGTH", side))
    return origin, turn, nodes.math("MULTIPLY", nodes.math("ADD", length, height), 0.5)


_FRAMES: dict[str, Callable[..., tuple[Any, Any, Any]]] = {
    "stga": _stga_frames,
    "gaussian_avatars": _gaussian_avatars_frames,
}


def _axes_to_rotation(
    nodes: Nodes, first: Any, edge: Any, side: Any, normal_axis: str
) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """Rotation whose x axis is `first` exactly, of a triangle with two edges from its first corner.

    Where `first` or the normal is missing, it takes what `avatar.embedding` takes; the node's own substitutes differ.
    Returns the rotation, the normal (its length twice the area) and whether `first` is missing.
    """
    normal = nodes.vector("CROSS_PRODUCT", edge, side)
    lengths = [nodes.vector("LENGTH", v) for v in (edge, side, nodes.vector("SUBTRACT", edge, side))]
    longest = nodes.math("MAXIMUM", nodes.math("MAXIMUM", lengths[0], lengths[1]), lengths[2])
    no_first = nodes.compare("LESS_EQUAL", nodes.vector("LENGTH", first), nodes.math("MULTIPLY", longest, SLIVER))
    limit = nodes.math("MULTIPLY", nodes.math("MULTIPLY", longest, longest), 2 * SLIVER)
    no_normal = nodes.compare("LESS_EQUAL", nodes.vector("LENGTH", normal), limit)
    first = nodes.switch("VECTOR", no_first, nodes.vector("NORMALIZE", first), (1, 0, 0))
    z = nodes.math("ABSOLUTE", nodes.vector("DOT_PRODUCT", first, (0, 0, 1)))
    helper = nodes.switch("VECTOR", nodes.compare("GREATER_THAN", z, UPRIGHT), (0, 0, 1), (1, 0, 0))
    second = nodes.vector("CROSS_PRODUCT", first, helper)
    second = nodes.switch("VECTOR", no_normal, nodes.vector("NORMALIZE", normal), second)
    axes = {"Primary Axis": first, "Secondary Axis": second}
    turn = nodes.out("FunctionNodeAxesToRotation", axes, primary_axis="X", secondary_axis=normal_axis)
    return turn, normal, no_first


def _frozen(nodes: Nodes, mesh: Any) -> bpy.types.NodeSocket:
    """Whether the current frame's selection leaves a splat's triangle out; never where the frame has no selection."""
    frame = nodes.out("FunctionNodeValueToString", {"Value": nodes.add("GeometryNodeInputSceneTime").outputs["Frame"]})
    name = nodes.out("FunctionNodeReplaceString", {"String": f"{tags.GROUP_PREFIX}#", "Find": "#", "Replace": frame})
    group = nodes.add("GeometryNodeInputNamedAttribute", {"Name": name}, data_type="FLOAT")
    weight, exists = (socket for socket in group.outputs if socket.enabled)
    chosen = nodes.compare("GREATER_EQUAL", weight, tags.SELECTED_WEIGHT)
    # Compared on the vertices: from there to a face, a boolean holds where all the face's vertices hold.
    frozen = nodes.logic("NIMPLY", exists, nodes.on_domain(chosen, "BOOLEAN", "POINT"))
    return nodes.sample(mesh, frozen, nodes.attribute(FACE, "INT"), "BOOLEAN")


_FRAMED = {
    convention: Part(f"STGA Frames ({convention})", {"Mesh": "Geometry"}, "Geometry", partial(_framed, convention))
    for convention in _FRAMES
}
_PLACED: dict[str | None, Part] = {
    None: Part("STGA Placed (world)", {"Splats": "Geometry"}, "Geometry", partial(_placed, None)),
    **{
        convention: Part(
            f"STGA Placed ({convention})",
            {"Splats": "Geometry", "Frames": "Geometry"},
            "Geometry",
            partial(_placed, convention),
        )
        for convention in _FRAMES
    },
}
_FROZEN_BY = Part("STGA Frozen", {"Mesh": "Geometry"}, "Bool", _frozen)
