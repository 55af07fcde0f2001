"""What stands for a splat in Blender: a point, an ellipsoid, a quad that faces the camera, or Blender's own splat."""

from contextlib import suppress
from typing import Any

import bpy

from ..compat import NATIVE_SPLATS
from .materials import EXTENT, ellipsoid_material, point_material
from .node_builder import Nodes, Part

# Attributes that the splats have by now, under the names that Blender's own splats use.
WORLD_ROTATION = "rotation"
WORLD_SCALE = "scale"

POINTS = "Points"
ELLIPSOIDS = "Ellipsoids"
QUADS = "Camera Quads"
NATIVE = "Native Splats"


def shown_as(nodes: Nodes, choice: Any, splats: Any, visible: Any, size: Any) -> Any:
    """Geometry of the splats as the menu socket `choice` wants them.

    visible: field, which splats; size: factor on their standard deviations.
    """
    kinds = {name: nodes.part(part, splats, visible, size) for name, part in PARTS.items()}
    native = _native(nodes, kinds[POINTS]) if NATIVE_SPLATS else None
    if native is not None:
        kinds[NATIVE] = native
    menu = nodes.add("GeometryNodeMenuSwitch", data_type="GEOMETRY")
    menu.enum_definition.enum_items.clear()
    for name in kinds:
        menu.enum_definition.enum_items.new(name)
    for name, geometry in kinds.items():
        nodes.tree.links.new(geometry, menu.inputs[name])
    nodes.tree.links.new(choice, menu.inputs["Menu"])
    return menu.outputs[0]


def _points(nodes: Nodes, splats: Any, visible: Any, size: Any) -> bpy.types.NodeSocket:
    # The mean of the three standard deviations stands for a shape that a point cannot show.
    mean = nodes.math("DIVIDE", nodes.vector("DOT_PRODUCT", nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR"), (1, 1, 1)), 3)
    radius = nodes.math("MULTIPLY", mean, size)
    points = nodes.out("GeometryNodeMeshToPoints", {"Mesh": splats, "Selection": visible, "Radius": radius})
    return nodes.out("GeometryNodeSetMaterial", {"Geometry": points, "Material": point_material()})


def _ellipsoids(nodes: Nodes, splats: Any, visible: Any, size: Any) -> bpy.types.NodeSocket:
    """Instances of one sphere; never realised, which would cost twenty times as much."""
    sphere = nodes.out("GeometryNodeMeshIcoSphere", {"Radius": EXTENT, "Subdivisions": 2})
    sphere = nodes.out("GeometryNodeSetShadeSmooth", {"Geometry": sphere})
    sphere = nodes.out("GeometryNodeSetMaterial", {"Geometry": sphere, "Material": ellipsoid_material()})
    return nodes.out(
        "GeometryNodeInstanceOnPoints",
        {
            "Points": splats,
            "Selection": visible,
            "Instance": sphere,
            "Rotation": nodes.attribute(WORLD_ROTATION, "QUATERNION"),
            "Scale": nodes.scaled(nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR"), size),
        },
    )


def _native(nodes: Nodes, points: Any) -> bpy.types.NodeSocket | None:
    """The points as Blender's own splats; None where the menu calls them by no name known from its source."""
    node = nodes.add("GeometryNodePointsSetType", {"Points": points})
    for name in ("Gaussian Splat", "Gaussian Splats", "GAUSSIAN_SPLAT"):
        with suppress(TypeError):  # there is no such item
            node.inputs["Type"].default_value = name
            return node.outputs[0]
    nodes.tree.nodes.remove(node)
    return None


def _quads(nodes: Nodes, splats: Any, visible: Any, size: Any) -> bpy.types.NodeSocket:
    """Two triangles a splat, which cover its ellipsoid as the scene's active camera sees it.

    In the ellipsoid's own space it is a sphere, and the quad faces the camera there; the material draws the same
    Gaussian on it as on the sphere, because it looks at rays and not at the surface they hit.
    """
    side = 2 * EXTENT
    quad = nodes.out("GeometryNodeMeshGrid", {"Size X": side, "Size Y": side, "Vertices X": 2, "Vertices Y": 2})
    quad = nodes.out("GeometryNodeSetMaterial", {"Geometry": quad, "Material": ellipsoid_material()})
    quads = nodes.out("GeometryNodeInstanceOnPoints", {"Points": splats, "Selection": visible, "Instance": quad})
    position = nodes.out("GeometryNodeInputPosition")
    rotation = nodes.attribute(WORLD_ROTATION, "QUATERNION")
    scale = nodes.scaled(nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR"), size)
    camera = nodes.object(nodes.out("GeometryNodeInputActiveCamera")).outputs["Location"]
    back = nodes.out("FunctionNodeInvertRotation", {"Rotation": rotation})
    toward = nodes.vector("SUBTRACT", camera, position)
    toward = nodes.out("FunctionNodeRotateVector", {"Vector": toward, "Rotation": back})
    toward = nodes.vector("NORMALIZE", nodes.vector("DIVIDE", toward, scale))
    axes = {"Primary Axis": toward, "Secondary Axis": (1, 0, 0)}
    turn = nodes.out("FunctionNodeAxesToRotation", axes, primary_axis="Z", secondary_axis="X")
    ellipsoid = nodes.out(
        "FunctionNodeCombineTransform", {"Translation": position, "Rotation": rotation, "Scale": scale}
    )
    facing = nodes.out("FunctionNodeCombineTransform", {"Rotation": turn})
    placed = nodes.out("FunctionNodeMatrixMultiply", {"Matrix": [ellipsoid, facing]})
    return nodes.out("GeometryNodeSetInstanceTransform", {"Instances": quads, "Transform": placed})


_INPUTS = {"Splats": "Geometry", "Visible": "Bool", "Size": "Float"}
PARTS = {
    POINTS: Part("STGA Points", _INPUTS, "Geometry", _points),
    ELLIPSOIDS: Part("STGA Ellipsoids", _INPUTS, "Geometry", _ellipsoids),
    QUADS: Part("STGA Camera Quads", _INPUTS, "Geometry", _quads),
}
