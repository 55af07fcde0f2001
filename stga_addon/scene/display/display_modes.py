"""Node groups and materials of the display modes: as trained, points, camera quads and, from 5.3,
native splats."""

from collections.abc import Callable
from functools import partial
from typing import Any

import bpy

from ...avatar.splats import SH_C0
from ..compat import native_splats
from .color_nodes import LINEAR_TO_SRGB
from .node_builder import NodeGroup, Nodes, new_material
from .splat_attributes import OPACITY, RELIT_COLOR, SH

POINT_MATERIAL = "STGA Points"
GAUSSIAN_MATERIAL = "STGA Gaussians"
DISPLAY_COLOR = "stga_display_color"  # attribute that the splat nodes store
EXTENT = 3.0
"""Standard deviations from a quad's center to its sides; beyond, a Gaussian is below 1.2 % of its
maximum."""


def point_material() -> bpy.types.Material:
    """Emits the color of a point cloud's points, with their opacity; built where the file has
    none."""
    # EEVEE does not sort the points of a point cloud.
    return _splat_material(
        POINT_MATERIAL,
        lambda nodes: _emission(nodes, *_color_and_opacity(nodes, "GEOMETRY")),
        "DITHERED",
    )


def gaussian_material() -> bpy.types.Material:
    """Renders instances of a quad as Gaussians; the instance's scale is the standard deviation.

    Along a ray with unit direction D through a point P of the quad, both in the instance's space,
    the Gaussian is densest where the ray is nearest to the center, at the squared distance |P|² −
    (P·D)²; its density there is taken for the whole splat. Exact for Cycles up to the order of
    overlapping splats, and for EEVEE up to their order by centers.
    """
    # EEVEE sorts instances: no noise. Stochastic transparency takes hundreds of samples to come as
    # close.
    return _splat_material(GAUSSIAN_MATERIAL, _gaussian_shader, "BLENDED")


def _splat_material(name: str, build: Callable[[Nodes], Any], method: str) -> bpy.types.Material:
    """method: EEVEE's, "DITHERED" or "BLENDED"."""
    material = bpy.data.materials.get(name)
    if material is None:
        material = new_material(name, build)
        material.surface_render_method = method
        material.use_backface_culling = True
    return material


def _gaussian_shader(nodes: Nodes) -> Any:
    color, opacity = _color_and_opacity(nodes, "INSTANCER")
    geometry = nodes.add("ShaderNodeNewGeometry").outputs
    position = nodes.add("ShaderNodeTexCoord").outputs["Object"]
    incoming = {"Vector": geometry["Incoming"]}
    ray = nodes.out(
        "ShaderNodeVectorTransform",
        incoming,
        vector_type="VECTOR",
        convert_from="WORLD",
        convert_to="OBJECT",
    )
    along = nodes.vector("DOT_PRODUCT", position, nodes.vector("NORMALIZE", ray))
    length2 = nodes.vector("DOT_PRODUCT", position, position)
    distance2 = nodes.math("SUBTRACT", length2, nodes.math("MULTIPLY", along, along))
    density = nodes.math("EXPONENT", nodes.math("MULTIPLY", distance2, -0.5))
    # Whatever is behind a quad sees through it.
    front = nodes.math("SUBTRACT", 1.0, geometry["Backfacing"])
    return _emission(
        nodes, color, nodes.math("MULTIPLY", nodes.math("MULTIPLY", density, front), opacity)
    )


def _color_and_opacity(nodes: Nodes, attribute_type: str) -> tuple[Any, Any]:
    """What the splat nodes stored on points ("GEOMETRY") or instances ("INSTANCER")."""
    color, opacity = (
        nodes.add("ShaderNodeAttribute", attribute_type=attribute_type, attribute_name=name).outputs
        for name in (DISPLAY_COLOR, OPACITY)
    )
    return color["Color"], opacity["Fac"]


def _emission(nodes: Nodes, color: Any, alpha: Any) -> Any:
    transparent, emission = (
        nodes.out("ShaderNodeBsdfTransparent"),
        nodes.out("ShaderNodeEmission", {"Color": color}),
    )
    return nodes.out("ShaderNodeMixShader", {"Fac": alpha, "Shader": [transparent, emission]})


# Attributes that Blender's native splats use; rotation and scale are those that the splats have by
# now.
WORLD_ROTATION = "rotation"
WORLD_SCALE = "scale"
RADIANCE = "radiance:base"  # coefficient of degree 0, and opacity
RADIANCE_SH = "radiance:sh_{}"  # coefficients of degrees 1 to 3

AS_TRAINED = "As Trained"
POINTS = "Points"
QUADS = "Camera Quads"
NATIVE = "Native Splats"
LIMITS = {
    AS_TRAINED: "Exact in viewports and by the engine STGA Splats; EEVEE and Cycles render camera quads",
    POINTS: "Fast: round, of each splat's mean size",
    QUADS: "For EEVEE and Cycles; right through the scene's camera only",
    NATIVE: "Blender's own splats, for Workbench, EEVEE and Cycles; not tried in Blender 5.3",
}
"""What each display is for and what it is not, in its tooltip and in the panel."""


def displayed(nodes: Nodes, mode: Any, splats: Any, visible: Any, size: Any, native: Any) -> Any:
    """Geometry of the splats in the display mode that the menu socket `mode` chooses.

    visible: field, which splats; size: factor on their standard deviations; native: points from
    NATIVE_GROUPS, None in a Blender without native splats.
    """
    made = {name: nodes.group(group, splats, visible, size) for name, group in MODES.items()}
    # Nothing in viewports, where `gpu.viewport_display` draws; in images by EEVEE and Cycles, quads
    # that face the camera.
    is_viewport = nodes.out("GeometryNodeIsViewport")
    in_images = nodes.out(
        "GeometryNodeSwitch", {"Switch": is_viewport, "False": made[QUADS]}, input_type="GEOMETRY"
    )
    geometries = {AS_TRAINED: in_images, **made}
    if native is not None and (points := native_splats(nodes.tree, native)) is not None:
        geometries[NATIVE] = points
    menu = nodes.add("GeometryNodeMenuSwitch", data_type="GEOMETRY")
    menu.enum_definition.enum_items.clear()
    for name in geometries:
        menu.enum_definition.enum_items.new(name).description = LIMITS[name]
    for name, geometry in geometries.items():
        nodes.tree.links.new(geometry, menu.inputs[name])
    nodes.tree.links.new(mode, menu.inputs["Menu"])
    return menu.outputs[0]


def _points(nodes: Nodes, splats: Any, visible: Any, size: Any) -> bpy.types.NodeSocket:
    # A point has one radius: the mean of the three standard deviations.
    mean = nodes.math(
        "DIVIDE",
        nodes.vector("DOT_PRODUCT", nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR"), (1, 1, 1)),
        3,
    )
    radius = nodes.math("MULTIPLY", mean, size)
    points = nodes.out(
        "GeometryNodeMeshToPoints", {"Mesh": splats, "Selection": visible, "Radius": radius}
    )
    return nodes.out("GeometryNodeSetMaterial", {"Geometry": points, "Material": point_material()})


def _quads(nodes: Nodes, splats: Any, visible: Any, size: Any) -> bpy.types.NodeSocket:
    """Two triangles per splat, which cover its ellipsoid as the scene's active camera sees it.

    In the ellipsoid's own space it is a sphere, and the quad faces the camera there. Instances:
    realizing them would take twenty times as long.
    """
    side = 2 * EXTENT
    quad = nodes.out(
        "GeometryNodeMeshGrid", {"Size X": side, "Size Y": side, "Vertices X": 2, "Vertices Y": 2}
    )
    quad = nodes.out("GeometryNodeSetMaterial", {"Geometry": quad, "Material": gaussian_material()})
    quads = nodes.out(
        "GeometryNodeInstanceOnPoints", {"Points": splats, "Selection": visible, "Instance": quad}
    )
    # Per splat: its ellipsoid's transform after a rotation that turns +Z to the active camera.
    position = nodes.out("GeometryNodeInputPosition")
    rotation = nodes.attribute(WORLD_ROTATION, "QUATERNION")
    scale = nodes.scale(nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR"), size)
    camera = nodes.object_info(nodes.out("GeometryNodeInputActiveCamera")).outputs["Location"]
    inverse = nodes.out("FunctionNodeInvertRotation", {"Rotation": rotation})
    to_camera = nodes.vector("SUBTRACT", camera, position)
    to_camera = nodes.out("FunctionNodeRotateVector", {"Vector": to_camera, "Rotation": inverse})
    to_camera = nodes.vector("NORMALIZE", nodes.vector("DIVIDE", to_camera, scale))
    axes = {"Primary Axis": to_camera, "Secondary Axis": (1, 0, 0)}
    facing = nodes.out("FunctionNodeAxesToRotation", axes, primary_axis="Z", secondary_axis="X")
    ellipsoid = {"Translation": position, "Rotation": rotation, "Scale": scale}
    transforms = [
        nodes.out("FunctionNodeCombineTransform", ellipsoid),
        nodes.out("FunctionNodeCombineTransform", {"Rotation": facing}),
    ]
    transform = nodes.out("FunctionNodeMatrixMultiply", {"Matrix": transforms})
    return nodes.out(
        "GeometryNodeSetInstanceTransform", {"Instances": quads, "Transform": transform}
    )


def _native(
    degree: int,
    nodes: Nodes,
    splats: Any,
    visible: Any,
    size: Any,
    color: Any,
    view_dependent: Any,
    gray: Any,
) -> bpy.types.NodeSocket:
    """Points with what native splats are drawn from: harmonics have the object's axes, in which
    they were trained.

    color: constant part, sRGB; gray: splats in one color, DISPLAY_COLOR, as are those that are
    relit.
    """
    relit = nodes.add(
        "GeometryNodeInputNamedAttribute", {"Name": RELIT_COLOR}, data_type="FLOAT_COLOR"
    ).outputs
    flat = nodes.logic("OR", gray, relit["Exists"])
    shown = nodes.group(LINEAR_TO_SRGB, nodes.attribute(DISPLAY_COLOR, "FLOAT_COLOR"))
    color = nodes.vector("SUBTRACT", nodes.switch("VECTOR", flat, color, shown), (0.5, 0.5, 0.5))
    red, green, blue = nodes.components(nodes.scale(color, 1 / SH_C0))
    base = {"Red": red, "Green": green, "Blue": blue, "Alpha": nodes.attribute(OPACITY, "FLOAT")}
    # A color, which 5.3 converts to four floats where it draws; of FLOAT4, this node of 5.2 stores
    # three.
    splats = nodes.store(
        splats, RADIANCE, nodes.out("FunctionNodeCombineColor", base), "FLOAT_COLOR"
    )
    scale = nodes.scale(nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR"), size)
    splats = nodes.store(splats, WORLD_SCALE, scale, "FLOAT_VECTOR")
    factor = nodes.logic("NIMPLY", view_dependent, flat)
    for index in range((degree + 1) ** 2 - 1):
        coefficient = nodes.scale(nodes.attribute(SH.format(index + 1), "FLOAT_VECTOR"), factor)
        splats = nodes.store(splats, RADIANCE_SH.format(index), coefficient, "FLOAT_VECTOR")
    return nodes.out("GeometryNodeMeshToPoints", {"Mesh": splats, "Selection": visible})


_INPUTS = {"Splats": "Geometry", "Visible": "Bool", "Size": "Float"}
MODES = {
    POINTS: NodeGroup("STGA Points", _INPUTS, "Geometry", _points),
    QUADS: NodeGroup("STGA Camera Quads", _INPUTS, "Geometry", _quads),
}
NATIVE_GROUPS = tuple(
    NodeGroup(
        f"STGA Native Splats {degree}",
        {**_INPUTS, "Color": "Vector", "View-Dependent": "Bool", "Gray": "Bool"},
        "Geometry",
        partial(_native, degree),
    )
    for degree in range(4)
)
"""By the harmonics' degree."""
