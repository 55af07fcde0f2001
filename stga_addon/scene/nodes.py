"""The geometry-node trees that make splats follow a mesh, without any Python at run time.

The splat object is a mesh of loose vertices, one per splat, whose attributes hold the trained values in the
frame of a triangle. The tree computes every triangle's frame on the head's *evaluated* mesh, samples the
frames by the splats' face index and composes position, rotation and scale.
"""

from collections.abc import Callable
from typing import Any

import bpy

from .. import __version__
from ..avatar.embedding import SLIVER, UPRIGHT
from . import tags
from .materials import DISPLAY_COLOR, EXTENT, OPACITY, ellipsoid_material, point_material

# Attributes of the splat object: what the tree reads (with OPACITY) ...
FACE = "stga_face"
XYZ = "stga_xyz"
ROTATION = "stga_rotation"
SCALE = "stga_scale"
COLOR = "stga_color"
SH_REST = "stga_sh_{}"
NEUTRAL_AREA = "stga_neutral_area"
# ... and what it writes (with DISPLAY_COLOR), under the names that Blender's own splats use.
WORLD_ROTATION = "rotation"
WORLD_SCALE = "scale"

# Inputs of the modifier, by the name a person sees.
HEAD = "Head"
ELLIPSOIDS = "Ellipsoids"
SIZE = "Size"
OPACITY_THRESHOLD = "Opacity Threshold"
PERCENTAGE = "Percentage"
SHOW_SELECTION = "Show Selection"

FROZEN_GREY = (0.25, 0.25, 0.25, 1.0)

_MADE_BY = "stga_version"


def splat_tree(convention: str | None) -> bpy.types.NodeTree:
    """The node tree for splats embedded by `convention` ("stga", "gaussian_avatars"), or None for world space.

    Built once per file; a tree that another version of the add-on left in the file is not reused.
    """
    name = f"STGA Splats ({convention or 'world'})"
    for tree in bpy.data.node_groups:
        if tree.name.startswith(name) and tree.get(_MADE_BY) == __version__:
            return tree
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree[_MADE_BY] = __version__
    tree.is_modifier = True
    _declare(tree, embedded=convention is not None)
    _build(_Nodes(tree), convention)
    return tree


def _declare(tree: bpy.types.NodeTree, embedded: bool) -> None:
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
    add(ELLIPSOIDS, "Bool", False).description = "Show each splat as the Gaussian it is; slower than points"
    add(SIZE, "Float", 1.0, 0.0).description = "Factor on the splats' size"
    add(OPACITY_THRESHOLD, "Float", 0.0, 0.0, 1.0).description = "Hide splats that are fainter than this"
    percentage = add(PERCENTAGE, "Float", 100.0, 0.0, 100.0)
    percentage.subtype = "PERCENTAGE"
    percentage.description = "Show only a random part of the splats"
    if embedded:
        selection = add(SHOW_SELECTION, "Bool", False)
        selection.description = "Turn grey what the current frame's selection freezes"


def is_splat_tree(tree: bpy.types.NodeTree) -> bool:
    """Whether `splat_tree` made the tree, in this version or another."""
    return _MADE_BY in tree


class _Nodes:
    """Short names for adding nodes: every method returns the new node's first enabled output socket."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def add(self, kind: str, inputs: dict[str, Any] | None = None, **properties: Any) -> bpy.types.Node:
        """New node; `inputs` maps an enabled socket's name or identifier to a value or socket.

        Several sockets of one name take a list. Names differ between Blender versions more often than identifiers.
        Raises ValueError where no socket has the name.
        """
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for name, values in (inputs or {}).items():
            sockets = [socket for socket in node.inputs if socket.enabled and name in (socket.name, socket.identifier)]
            values = values if isinstance(values, list) else [values]
            for socket, value in zip(sockets, values, strict=True):
                if isinstance(value, bpy.types.NodeSocket):
                    self.tree.links.new(value, socket)
                else:
                    socket.default_value = value
        return node

    def out(self, kind: str, inputs: dict[str, Any] | None = None, **properties: Any) -> bpy.types.NodeSocket:
        node = self.add(kind, inputs, **properties)
        return next(socket for socket in node.outputs if socket.enabled)

    def math(self, operation: str, *values: Any) -> bpy.types.NodeSocket:
        return self.out("ShaderNodeMath", {"Value": list(values)}, operation=operation)

    def vector(self, operation: str, *values: Any) -> bpy.types.NodeSocket:
        return self.out("ShaderNodeVectorMath", {"Vector": list(values)}, operation=operation)

    def compare(self, operation: str, a: Any, b: Any) -> bpy.types.NodeSocket:
        return self.out("FunctionNodeCompare", {"A": a, "B": b}, data_type="FLOAT", operation=operation)

    def scaled(self, vector: Any, factor: Any) -> bpy.types.NodeSocket:
        return self.out("ShaderNodeVectorMath", {"Vector": vector, "Scale": factor}, operation="SCALE")

    def attribute(self, name: Any, data_type: str) -> bpy.types.NodeSocket:
        return self.out("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=data_type)

    def store(self, geometry: Any, name: str, value: Any, data_type: str, domain: str = "POINT") -> Any:
        return self.out(
            "GeometryNodeStoreNamedAttribute",
            {"Geometry": geometry, "Name": name, "Value": value},
            data_type=data_type,
            domain=domain,
        )

    def sample_face(self, geometry: Any, value: Any, index: Any, data_type: str) -> bpy.types.NodeSocket:
        return self.out(
            "GeometryNodeSampleIndex",
            {"Geometry": geometry, "Value": value, "Index": index},
            data_type=data_type,
            domain="FACE",
        )

    def switch(self, kind: str, condition: Any, no: Any, yes: Any) -> bpy.types.NodeSocket:
        return self.out("GeometryNodeSwitch", {"Switch": condition, "False": no, "True": yes}, input_type=kind)


def _build(nodes: _Nodes, convention: str | None) -> None:
    inputs = nodes.tree.nodes.new("NodeGroupInput").outputs
    xyz = nodes.attribute(XYZ, "FLOAT_VECTOR")
    rotation = nodes.attribute(ROTATION, "QUATERNION")
    scale = nodes.attribute(SCALE, "FLOAT_VECTOR")
    color = nodes.attribute(COLOR, "FLOAT_COLOR")
    if convention is not None:
        head = nodes.add("GeometryNodeObjectInfo", {"Object": inputs[HEAD]}, transform_space="RELATIVE")
        mesh = head.outputs["Geometry"]
        origin, turn, size = _sampled_frames(nodes, mesh, convention)
        xyz = nodes.out("FunctionNodeRotateVector", {"Vector": nodes.scaled(xyz, size), "Rotation": turn})
        xyz = nodes.vector("ADD", xyz, origin)
        rotation = nodes.out(
            "FunctionNodeRotateRotation", {"Rotation": rotation, "Rotate By": turn}, rotation_space="GLOBAL"
        )
        scale = nodes.scaled(scale, size)
        color = nodes.switch("RGBA", _frozen(nodes, mesh, inputs[SHOW_SELECTION]), color, FROZEN_GREY)
    splats = nodes.out("GeometryNodeSetPosition", {"Geometry": inputs["Geometry"], "Position": xyz})
    splats = nodes.store(splats, WORLD_ROTATION, rotation, "QUATERNION")
    splats = nodes.store(splats, WORLD_SCALE, scale, "FLOAT_VECTOR")
    splats = nodes.store(splats, DISPLAY_COLOR, color, "FLOAT_COLOR")
    shown = nodes.switch("GEOMETRY", inputs[ELLIPSOIDS], _points(nodes, splats), _ellipsoids(nodes, splats))
    output = nodes.tree.nodes.new("NodeGroupOutput")
    nodes.tree.links.new(shown, output.inputs["Geometry"])
    _lay_out(nodes.tree)


def _sampled_frames(nodes: _Nodes, mesh: Any, convention: str) -> tuple[Any, Any, Any]:
    """Origin, rotation and scale of each splat's triangle (`avatar.embedding.face_frames` as nodes)."""
    # Stored on the mesh first: sampling a stored attribute is cheap, sampling a field computes it again.
    origin, turn, size = _FRAMES[convention](nodes)
    mesh = nodes.store(mesh, "stga_frame_origin", origin, "FLOAT_VECTOR", "FACE")
    mesh = nodes.store(mesh, "stga_frame_rotation", turn, "QUATERNION", "FACE")
    mesh = nodes.store(mesh, "stga_frame_size", size, "FLOAT", "FACE")
    face = nodes.attribute(FACE, "INT")

    def sample(name: str, kind: str) -> Any:
        return nodes.sample_face(mesh, nodes.attribute(name, kind), face, kind)

    size = sample("stga_frame_size", "FLOAT")
    if convention == "stga":
        neutral = nodes.attribute(NEUTRAL_AREA, "FLOAT")
        ratio = nodes.math("SQRT", nodes.math("DIVIDE", size, neutral))
        # No neutral area, no meaningful ratio: the local metres stay as they are.
        size = nodes.switch("FLOAT", nodes.compare("GREATER_THAN", neutral, 0.0), 1.0, ratio)
    return sample("stga_frame_origin", "FLOAT_VECTOR"), sample("stga_frame_rotation", "QUATERNION"), size


def _stga_frames(nodes: _Nodes) -> tuple[Any, Any, Any]:
    """Centroid; axes [n(p0−o), ·, normal]; the triangle's area (its ratio to the neutral area is the square of k)."""
    p0, p1, p2 = (_corner(nodes, index) for index in range(3))
    origin = nodes.scaled(nodes.vector("ADD", nodes.vector("ADD", p0, p1), p2), 1 / 3)
    edge, side = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
    # p0 − origin without the origin, which rounds: it must vanish where the corners coincide.
    first = nodes.scaled(nodes.vector("ADD", edge, side), -1 / 3)
    turn, normal, _ = _axes_to_rotation(nodes, first, edge, side, "Z")
    return origin, turn, nodes.math("MULTIPLY", nodes.vector("LENGTH", normal), 0.5)


def _gaussian_avatars_frames(nodes: _Nodes) -> tuple[Any, Any, Any]:
    """Centroid; axes [n(p1−p0), normal, ·]; mean of the first edge and the height over it."""
    p0, p1, p2 = (_corner(nodes, index) for index in range(3))
    origin = nodes.scaled(nodes.vector("ADD", nodes.vector("ADD", p0, p1), p2), 1 / 3)
    edge, side = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
    turn, normal, no_edge = _axes_to_rotation(nodes, edge, edge, side, "Y")
    # Height over the edge = |edge × side| / |edge|, or the side where the edge has no length.
    length = nodes.vector("LENGTH", edge)
    height = nodes.math("DIVIDE", nodes.vector("LENGTH", normal), length)
    height = nodes.switch("FLOAT", no_edge, height, nodes.vector("LENGTH", side))
    return origin, turn, nodes.math("MULTIPLY", nodes.math("ADD", length, height), 0.5)


_FRAMES: dict[str, Callable[[_Nodes], tuple[Any, Any, Any]]] = {
    "stga": _stga_frames,
    "gaussian_avatars": _gaussian_avatars_frames,
}


def _corner(nodes: _Nodes, index: int) -> bpy.types.NodeSocket:
    """Position of a triangle's corner in the order in which the face lists its vertices."""
    corner = nodes.out("GeometryNodeCornersOfFace", {"Sort Index": index})
    vertex = nodes.out("GeometryNodeVertexOfCorner", {"Corner Index": corner})
    return nodes.out(
        "GeometryNodeFieldAtIndex",
        {"Index": vertex, "Value": nodes.out("GeometryNodeInputPosition")},
        data_type="FLOAT_VECTOR",
        domain="POINT",
    )


def _axes_to_rotation(
    nodes: _Nodes, first: Any, edge: Any, side: Any, normal_axis: str
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


def _points(nodes: _Nodes, splats: Any) -> bpy.types.NodeSocket:
    group = nodes.tree.nodes.new("NodeGroupInput").outputs
    # The mean of the three standard deviations stands for a shape that a point cannot show.
    mean = nodes.math("DIVIDE", nodes.vector("DOT_PRODUCT", nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR"), (1, 1, 1)), 3)
    radius = nodes.math("MULTIPLY", mean, group[SIZE])
    points = nodes.out("GeometryNodeMeshToPoints", {"Mesh": splats, "Selection": _shown(nodes), "Radius": radius})
    return nodes.out("GeometryNodeSetMaterial", {"Geometry": points, "Material": point_material()})


def _ellipsoids(nodes: _Nodes, splats: Any) -> bpy.types.NodeSocket:
    """Instances of one sphere; never realised, which would cost twenty times as much."""
    group = nodes.tree.nodes.new("NodeGroupInput").outputs
    sphere = nodes.out("GeometryNodeMeshIcoSphere", {"Radius": EXTENT, "Subdivisions": 2})
    sphere = nodes.out("GeometryNodeSetShadeSmooth", {"Geometry": sphere})
    sphere = nodes.out("GeometryNodeSetMaterial", {"Geometry": sphere, "Material": ellipsoid_material()})
    return nodes.out(
        "GeometryNodeInstanceOnPoints",
        {
            "Points": splats,
            "Selection": _shown(nodes),
            "Instance": sphere,
            "Rotation": nodes.attribute(WORLD_ROTATION, "QUATERNION"),
            "Scale": nodes.scaled(nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR"), group[SIZE]),
        },
    )


def _shown(nodes: _Nodes) -> bpy.types.NodeSocket:
    """Which splats are displayed: opaque enough, and in the random part."""
    group = nodes.tree.nodes.new("NodeGroupInput").outputs
    opaque = nodes.compare("GREATER_EQUAL", nodes.attribute(OPACITY, "FLOAT"), group[OPACITY_THRESHOLD])
    # Above 0 so that 0 % shows nothing, up to 100 so that 100 % shows all.
    draw = nodes.out("FunctionNodeRandomValue", {"Min": 1e-6, "Max": 100.0}, data_type="FLOAT")
    drawn = nodes.compare("LESS_EQUAL", draw, group[PERCENTAGE])
    return nodes.out("FunctionNodeBooleanMath", {"Boolean": [opaque, drawn]}, operation="AND")


def _frozen(nodes: _Nodes, mesh: Any, show: Any) -> bpy.types.NodeSocket:
    """Whether the current frame's selection leaves a splat's triangle out; never where the frame has no selection."""
    frame = nodes.out("FunctionNodeValueToString", {"Value": nodes.add("GeometryNodeInputSceneTime").outputs["Frame"]})
    name = nodes.out("FunctionNodeReplaceString", {"String": f"{tags.GROUP_PREFIX}#", "Find": "#", "Replace": frame})
    group = nodes.add("GeometryNodeInputNamedAttribute", {"Name": name}, data_type="FLOAT")
    weight, exists = (socket for socket in group.outputs if socket.enabled)
    chosen = nodes.compare("GREATER_EQUAL", weight, tags.SELECTED_WEIGHT)
    # Compared on the vertices: from there to a face, a boolean holds where all the face's vertices hold.
    chosen = nodes.out("GeometryNodeFieldOnDomain", {"Value": chosen}, data_type="BOOLEAN", domain="POINT")
    frozen = nodes.out("FunctionNodeBooleanMath", {"Boolean": [exists, chosen]}, operation="NIMPLY")
    frozen = nodes.sample_face(mesh, frozen, nodes.attribute(FACE, "INT"), "BOOLEAN")
    return nodes.out("FunctionNodeBooleanMath", {"Boolean": [frozen, show]}, operation="AND")


def _lay_out(tree: bpy.types.NodeTree) -> None:
    """Columns from input to output, for a person who opens the tree."""
    depth: dict[str, int] = {}

    def place(node: bpy.types.Node, at: int) -> None:
        if depth.get(node.name, -1) < at:
            depth[node.name] = at
            for source in sources.get(node.name, ()):
                place(source, at + 1)

    sources: dict[str, list[bpy.types.Node]] = {}
    for link in tree.links:
        sources.setdefault(link.to_node.name, []).append(link.from_node)
    place(next(node for node in tree.nodes if node.type == "GROUP_OUTPUT"), 0)
    rows: dict[int, int] = {}
    for node in tree.nodes:
        column = depth.get(node.name, 0)
        node.location = (-220 * column, -200 * rows.get(column, 0))
        rows[column] = rows.get(column, 0) + 1
