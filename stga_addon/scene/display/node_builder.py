"""A short hand for writing node trees, and for making them of small parts."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import bpy

from ... import __version__

_MADE_BY = "stga_version"


def new_tree(name: str) -> bpy.types.NodeTree:
    """An empty geometry node tree that `made_tree` finds again."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree[_MADE_BY] = __version__
    return tree


def made_tree(name: str) -> bpy.types.NodeTree | None:
    """The tree of this name that this version of the add-on made, or None: what another version left is not reused."""
    trees = (tree for tree in bpy.data.node_groups if tree.name.startswith(name) and tree.get(_MADE_BY) == __version__)
    return next(trees, None)


def is_splat_tree(tree: bpy.types.NodeTree) -> bool:
    """Whether `nodes.splat_tree` made the tree, in this version or another."""
    return _MADE_BY in tree and bool(tree.is_modifier)


@dataclass(frozen=True)
class Part:
    """A node group with one output, built once per file.

    Blender looks at a whole tree after each of its edits, so a tree takes time in proportion to the square of its
    nodes; of parts, it takes little, and can be built in slices between which a person can go on working.

    name     after the dot, which keeps the part out of Blender's menus
    inputs   name -> kind of socket ("Vector")
    output   kind of socket
    build    takes the Nodes to build with and the inputs' sockets, in their order; returns the output's socket
    """

    name: str
    inputs: Mapping[str, str]
    output: str
    build: Callable[..., bpy.types.NodeSocket]

    def is_made(self) -> bool:
        return made_tree(f".{self.name}") is not None

    def tree(self) -> bpy.types.NodeTree:
        """The part's tree, built where the file has none."""
        made = made_tree(f".{self.name}")
        if made is not None:
            return made
        tree = new_tree(f".{self.name}")
        tree.interface.new_socket(self.output, in_out="OUTPUT", socket_type=f"NodeSocket{self.output}")
        for name, kind in self.inputs.items():
            tree.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
        given = tree.nodes.new("NodeGroupInput").outputs
        result = self.build(Nodes(tree), *(given[name] for name in self.inputs))
        tree.links.new(result, tree.nodes.new("NodeGroupOutput").inputs[self.output])
        lay_out(tree)
        return tree


class Nodes:
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

    def part(self, part: Part, *values: Any) -> bpy.types.NodeSocket:
        """Output of a part; values or sockets for its inputs, in their order."""
        inputs = dict(zip(part.inputs, values, strict=True))
        return self.out("GeometryNodeGroup", inputs, node_tree=part.tree())

    def math(self, operation: str, *values: Any) -> bpy.types.NodeSocket:
        return self.out("ShaderNodeMath", {"Value": list(values)}, operation=operation)

    def vector(self, operation: str, *values: Any) -> bpy.types.NodeSocket:
        return self.out("ShaderNodeVectorMath", {"Vector": list(values)}, operation=operation)

    def plus(self, *vectors: Any) -> bpy.types.NodeSocket:
        total = vectors[0]
        for vector in vectors[1:]:
            total = self.vector("ADD", total, vector)
        return total

    def compare(self, operation: str, a: Any, b: Any) -> bpy.types.NodeSocket:
        return self.out("FunctionNodeCompare", {"A": a, "B": b}, data_type="FLOAT", operation=operation)

    def scaled(self, vector: Any, factor: Any) -> bpy.types.NodeSocket:
        return self.out("ShaderNodeVectorMath", {"Vector": vector, "Scale": factor}, operation="SCALE")

    def attribute(self, name: Any, data_type: str) -> bpy.types.NodeSocket:
        return self.out("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=data_type)

    def object(self, thing: Any, space: str = "RELATIVE") -> bpy.types.Node:
        """Object Info: "RELATIVE" gives geometry and location in the space of the object that has the modifier."""
        return self.add("GeometryNodeObjectInfo", {"Object": thing}, transform_space=space)

    def components(self, vector: Any) -> list[bpy.types.NodeSocket]:
        return list(self.add("ShaderNodeSeparateXYZ", {"Vector": vector}).outputs)

    def combine(self, x: Any, y: Any, z: Any) -> bpy.types.NodeSocket:
        return self.out("ShaderNodeCombineXYZ", {"X": x, "Y": y, "Z": z})

    def store(self, geometry: Any, name: str, value: Any, data_type: str, domain: str = "POINT") -> Any:
        return self.out(
            "GeometryNodeStoreNamedAttribute",
            {"Geometry": geometry, "Name": name, "Value": value},
            data_type=data_type,
            domain=domain,
        )

    def sample(self, geometry: Any, value: Any, index: Any, data_type: str, domain: str = "FACE") -> Any:
        return self.out(
            "GeometryNodeSampleIndex",
            {"Geometry": geometry, "Value": value, "Index": index},
            data_type=data_type,
            domain=domain,
        )

    def at(self, value: Any, index: Any) -> bpy.types.NodeSocket:
        """A vector field of the points, at another point."""
        return self.out(
            "GeometryNodeFieldAtIndex", {"Index": index, "Value": value}, data_type="FLOAT_VECTOR", domain="POINT"
        )

    def corner(self, index: int) -> bpy.types.NodeSocket:
        """Vertex of a face's corner, in the order in which the face lists its vertices."""
        corner = self.out("GeometryNodeCornersOfFace", {"Sort Index": index})
        return self.out("GeometryNodeVertexOfCorner", {"Corner Index": corner})

    def on_domain(self, value: Any, data_type: str, domain: str) -> bpy.types.NodeSocket:
        """A field as another domain sees it: faces to points and back are plain means of the touching elements."""
        return self.out("GeometryNodeFieldOnDomain", {"Value": value}, data_type=data_type, domain=domain)

    def logic(self, operation: str, a: Any, b: Any) -> bpy.types.NodeSocket:
        return self.out("FunctionNodeBooleanMath", {"Boolean": [a, b]}, operation=operation)

    def switch(self, kind: str, condition: Any, no: Any, yes: Any) -> bpy.types.NodeSocket:
        return self.out("GeometryNodeSwitch", {"Switch": condition, "False": no, "True": yes}, input_type=kind)


def lay_out(tree: bpy.types.NodeTree) -> None:
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
    places: list[float] = []
    for node in tree.nodes:
        column = depth.get(node.name, 0)
        places += (-220.0 * column, -200.0 * rows.get(column, 0))
        rows[column] = rows.get(column, 0) + 1
    tree.nodes.foreach_set("location", places)  # one by one, each would update the whole tree
