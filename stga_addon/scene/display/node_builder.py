"""Node trees: short names for adding nodes, groups built once per file, new materials."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any

import bpy

from ... import __version__
from .. import compat

Socket = Any
"""A `bpy.types.NodeSocket`."""
Tree = Any
"""A `bpy.types.NodeTree`."""

VERSION = "stga_version"  # property of our trees: `_version`
_COLUMN_WIDTH = 220.0
_ROW_HEIGHT = 200.0


def new_tree(name: str) -> Tree:
    """An empty geometry node tree that `find_tree` finds again."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree[VERSION] = _version()
    return tree


def find_tree(name: str) -> Tree | None:
    """The tree of this name for which `is_current` is true, or None."""
    for tree in bpy.data.node_groups:
        if tree.name.startswith(name) and is_current(tree):
            return tree
    return None


def is_current(tree: Tree) -> bool:
    """Whether this version of the add-on made the tree, in a Blender with the same nodes."""
    return bool(tree.get(VERSION) == _version())


def _version() -> str:
    lit = " and lit native" if compat.NATIVE_SPLATS else ""
    return f"{__version__} with unseen{lit} splats on subdivided, not on lost heads"


def new_socket(tree: Tree, name: str, side: str, kind: str) -> Any:
    """Add an input or output ("INPUT", "OUTPUT") of a socket type ("Vector") to the tree."""
    return tree.interface.new_socket(name, in_out=side, socket_type=f"NodeSocket{kind}")


@dataclass(frozen=True)
class NodeGroup:
    """A node group with one output, built once per file. Blender validates a whole tree after each
    edit: small groups are built fast, and one at a time while the UI goes on. name: "." is put
    before it, which hides it in menus. inputs: name -> socket type ("Vector"). build: from the
    Nodes and the inputs' sockets, in order, to the output's."""

    name: str
    inputs: Mapping[str, str]
    output: str
    build: Callable[..., Socket]

    def tree(self) -> Tree:
        """The group's tree, built where the file has none."""
        if (existing := find_tree(f".{self.name}")) is not None:
            return existing
        tree = new_tree(f".{self.name}")
        new_socket(tree, self.output, "OUTPUT", self.output)
        for name, kind in self.inputs.items():
            new_socket(tree, name, "INPUT", kind)
        nodes = Nodes(tree)
        inputs = nodes.add("NodeGroupInput").outputs
        result = self.build(nodes, *(inputs[name] for name in self.inputs))
        nodes.finish("NodeGroupOutput", {self.output: result})
        return tree


def new_material(name: str, build: Callable[["Nodes"], Socket]) -> bpy.types.Material:
    """A material whose surface is the shader that `build` returns."""
    material = bpy.data.materials.new(name)
    tree = compat.enable_nodes(material)
    tree.nodes.clear()
    nodes = Nodes(tree)
    nodes.finish("ShaderNodeOutputMaterial", {"Surface": build(nodes)})
    return material


def kept_material(name: str, build: Callable[["Nodes"], Any], method: str) -> bpy.types.Material:
    """Built where the file has none; method: EEVEE's, "DITHERED" or "BLENDED"."""
    material = bpy.data.materials.get(name)
    if material is None:
        material = new_material(name, build)
        material.surface_render_method = method
        material.use_backface_culling = True
    return material


class Nodes:
    """Adds nodes to a tree; most methods return the first enabled output of the node they name."""

    def __init__(self, tree: Tree) -> None:
        self.tree = tree

    def add(
        self, kind: str, inputs: Mapping[str, Any] | None = None, **properties: Any
    ) -> bpy.types.Node:
        """New node; `inputs`: name or identifier of enabled sockets -> value or socket, a list for
        several of one name. Raises ValueError where no socket has the name."""
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        self.set_inputs(node, inputs or {})
        return node

    def set_inputs(self, node: bpy.types.Node, inputs: Mapping[str, Any]) -> None:
        for name, values in inputs.items():
            named = [s for s in node.inputs if s.enabled and name in (s.name, s.identifier)]
            values = values if isinstance(values, list) else [values]
            for socket, value in zip(named, values, strict=True):
                if isinstance(value, bpy.types.NodeSocket):
                    self.tree.links.new(value, socket)
                else:
                    socket.default_value = value

    def finish(self, kind: str, inputs: Mapping[str, Any]) -> None:
        """Add the tree's output node and arrange all nodes in columns, by links to it."""
        sources = defaultdict[str, list[str]](list)
        columns = dict[str, int]()
        waiting = [(self.add(kind, inputs).name, 0)]
        for link in self.tree.links:
            sources[link.to_node.name].append(link.from_node.name)
        while waiting:
            name, column = waiting.pop()
            if columns.get(name, -1) < column:
                columns[name] = column
                waiting += [(source, column + 1) for source in sources[name]]
        rows = Counter[int]()
        locations = list[float]()
        for node in self.tree.nodes:
            column = columns.get(node.name, 0)
            locations += (-_COLUMN_WIDTH * column, -_ROW_HEIGHT * rows[column])
            rows[column] += 1
        # one by one, each would update the whole tree
        self.tree.nodes.foreach_set("location", locations)

    def out(self, kind: str, inputs: Mapping[str, Any] | None = None, **properties: Any) -> Socket:
        node = self.add(kind, inputs, **properties)
        return next(socket for socket in node.outputs if socket.enabled)

    def group(self, group: NodeGroup, *values: Any) -> Socket:
        """Output of a node group; values or sockets for its inputs, in their order."""
        inputs = dict(zip(group.inputs, values, strict=True))
        return self.out("GeometryNodeGroup", inputs, node_tree=group.tree())

    def math(self, operation: str, *values: Any) -> Socket:
        return self.out("ShaderNodeMath", {"Value": list(values)}, operation=operation)

    def vector(self, operation: str, *values: Any) -> Socket:
        return self.out("ShaderNodeVectorMath", {"Vector": list(values)}, operation=operation)

    def sum(self, *vectors: Any) -> Socket:
        return reduce(partial(self.vector, "ADD"), vectors)

    def scale(self, vector: Any, factor: Any) -> Socket:
        inputs = {"Vector": vector, "Scale": factor}
        return self.out("ShaderNodeVectorMath", inputs, operation="SCALE")

    def components(self, vector: Any) -> list[Socket]:
        return list(self.add("ShaderNodeSeparateXYZ", {"Vector": vector}).outputs)

    def combine(self, x: Any, y: Any, z: Any) -> Socket:
        return self.out("ShaderNodeCombineXYZ", {"X": x, "Y": y, "Z": z})

    def compare(self, operation: str, a: Any, b: Any) -> Socket:
        kind = {"data_type": "FLOAT", "operation": operation}
        return self.out("FunctionNodeCompare", {"A": a, "B": b}, **kind)

    def logic(self, operation: str, a: Any, b: Any) -> Socket:
        return self.out("FunctionNodeBooleanMath", {"Boolean": [a, b]}, operation=operation)

    def switch(self, kind: str, condition: Any, false: Any, true: Any) -> Socket:
        inputs = {"Switch": condition, "False": false, "True": true}
        return self.out("GeometryNodeSwitch", inputs, input_type=kind)

    def menu(
        self, kind: str, choice: Any, values: Mapping[str, Any], descriptions: Mapping[str, str]
    ) -> Socket:
        """What the menu socket `choice` has chosen of values or sockets by name."""
        node = self.add("GeometryNodeMenuSwitch", data_type=kind)
        node.enum_definition.enum_items.clear()
        for name in values:
            node.enum_definition.enum_items.new(name).description = descriptions[name]
        self.set_inputs(node, {**values, "Menu": choice})
        return node.outputs[0]

    def attribute(self, name: Any, data_type: str = "FLOAT_VECTOR") -> Socket:
        return self.attribute_if_any(name, data_type)[0]

    def attribute_if_any(self, name: Any, data_type: str) -> list[Socket]:
        """The attribute, and whether it is there."""
        kind = "GeometryNodeInputNamedAttribute"
        node = self.add(kind, {"Name": name}, data_type=data_type)
        return [socket for socket in node.outputs if socket.enabled]

    def store(self, mesh: Any, name: str, value: Any, data_type: str, domain: str = "POINT") -> Any:
        inputs = {"Geometry": mesh, "Name": name, "Value": value}
        kind = {"data_type": data_type}
        return self.out("GeometryNodeStoreNamedAttribute", inputs, domain=domain, **kind)

    def sample(self, mesh: Any, value: Any, index: Any, kind: str, domain: str = "FACE") -> Any:
        inputs = {"Geometry": mesh, "Value": value, "Index": index}
        return self.out("GeometryNodeSampleIndex", inputs, data_type=kind, domain=domain)

    def at_points(self, value: Any, kind: str) -> Socket:
        """A field of faces interpolated to points: means of the touching elements."""
        inputs = {"Value": value}
        return self.out("GeometryNodeFieldOnDomain", inputs, data_type=kind, domain="POINT")

    def triangle_corners(self) -> list[Socket]:
        """Positions of each face's three corners, in the order of its vertices."""
        position = self.out("GeometryNodeInputPosition")
        found = []
        kind = {"data_type": "FLOAT_VECTOR", "domain": "POINT"}
        for number in range(3):
            corner = self.out("GeometryNodeCornersOfFace", {"Sort Index": number})
            point = self.out("GeometryNodeVertexOfCorner", {"Corner Index": corner})
            inputs = {"Index": point, "Value": position}
            found.append(self.out("GeometryNodeFieldAtIndex", inputs, **kind))
        return found

    def object_info(self, obj: Any, space: str = "RELATIVE") -> bpy.types.Node:
        """Object Info; "RELATIVE": in the space of the object that has the modifier."""
        return self.add("GeometryNodeObjectInfo", {"Object": obj}, transform_space=space)
