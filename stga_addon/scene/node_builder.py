"""A short hand for writing node trees."""

from typing import Any

import bpy


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
