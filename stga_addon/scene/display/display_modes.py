"""Node groups and materials of the display modes, and of colors by direction and strain."""

from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import bpy

from ...avatar.splats import SH_C0, harmonics
from ..compat import native_splats
from .node_builder import NodeGroup, Nodes, new_material
from .splat_attributes import OPACITY, RELIT_COLOR, SH, STRAIN_COLOR


def constant_color(nodes: Nodes, strain: Any) -> Any:
    """The part of each splat's sRGB color, not clamped, that does not depend on the view direction.

    strain: vector from SAMPLED_STRAIN, None where colors do not follow it. Coefficients as in
    `Splats`.
    """
    terms = [nodes.scale(nodes.attribute(SH.format(0), "FLOAT_VECTOR"), SH_C0), (0.5, 0.5, 0.5)]
    for index, factor in enumerate(() if strain is None else nodes.components(strain)):
        color = nodes.attribute(STRAIN_COLOR.format(index), "FLOAT_VECTOR")
        terms.append(nodes.scale(color, factor))
    return nodes.sum(*terms)


def view_color(nodes: Nodes, color: Any, degree: int) -> tuple[Any, Any]:
    """The constant color plus harmonics of degrees 1 to `degree` from the scene's active camera,
    in the space that splats were trained in, and whether there is a camera."""
    camera = nodes.object_info(nodes.out("GeometryNodeInputActiveCamera")).outputs["Location"]
    position = nodes.out("GeometryNodeInputPosition")
    direction = nodes.vector("NORMALIZE", nodes.vector("SUBTRACT", position, camera))
    seen = nodes.sum(color, *(nodes.group(band, direction) for band in SH_BANDS[:degree]))
    # Without a camera object the location is zero, which is inside the head: no camera is there.
    return seen, nodes.compare("GREATER_THAN", nodes.vector("LENGTH", camera), 0.0)


def _srgb_to_linear(nodes: Nodes, srgb: Any) -> Any:
    """Scene-linear color of sRGB, clamped to 0…1 (IEC 61966-2-1)."""
    clamped = nodes.vector("MINIMUM", nodes.vector("MAXIMUM", srgb, (0, 0, 0)), (1, 1, 1))
    linear = []
    for value in nodes.components(clamped):
        base = nodes.math("DIVIDE", nodes.math("ADD", value, 0.055), 1.055)
        line, power = nodes.math("DIVIDE", value, 12.92), nodes.math("POWER", base, 2.4)
        is_bright = nodes.compare("GREATER_THAN", value, 0.04045)
        linear.append(nodes.switch("FLOAT", is_bright, line, power))
    return nodes.combine(*linear)


def _linear_to_srgb(nodes: Nodes, color: Any) -> Any:
    """The inverse, of colors from 0 on."""
    srgb = []
    for value in nodes.components(color):
        power = nodes.math("MULTIPLY_ADD", nodes.math("POWER", value, 1 / 2.4), 1.055, -0.055)
        line = nodes.math("MULTIPLY", value, 12.92)
        is_bright = nodes.compare("GREATER_THAN", value, 0.0031308)
        srgb.append(nodes.switch("FLOAT", is_bright, line, power))
    return nodes.combine(*srgb)


class _Formula:
    """Arithmetic of numbers and sockets, whose nodes are made once its socket is asked for."""

    def __init__(self, make: Callable[[], Any], nodes: Nodes) -> None:
        self._make, self._nodes = make, nodes

    @cached_property
    def socket(self) -> Any:
        return self._make()

    def _with(self, operation: str, other: Any) -> "_Formula":
        def make() -> Any:
            value = other.socket if isinstance(other, _Formula) else other
            return self._nodes.math(operation, self.socket, value)

        return _Formula(make, self._nodes)

    def __mul__(self, other: Any) -> "_Formula":
        return self._with("MULTIPLY", other)

    def __sub__(self, other: Any) -> "_Formula":
        return self._with("SUBTRACT", other)

    __rmul__ = __mul__


def _band(degree: int, nodes: Nodes, direction: Any) -> Any:
    """Sum of the coefficients of one degree times their harmonics in a unit direction."""
    x, y, z = nodes.components(direction)
    axes = _Formula(lambda: x, nodes), _Formula(lambda: y, nodes), _Formula(lambda: z, nodes)
    total, terms = (0, 0, 0), harmonics(*axes)
    for index in range(degree**2, (degree + 1) ** 2):
        coefficient = nodes.attribute(SH.format(index), "FLOAT_VECTOR")
        total = nodes.vector("MULTIPLY_ADD", coefficient, terms[index].socket, total)
    return total


SRGB_TO_LINEAR = NodeGroup("STGA sRGB to Linear", {"sRGB": "Vector"}, "Color", _srgb_to_linear)
LINEAR_TO_SRGB = NodeGroup("STGA Linear to sRGB", {"Color": "Color"}, "Vector", _linear_to_srgb)
SH_BANDS = tuple(
    NodeGroup(f"STGA Spherical Harmonics {n}", {"Direction": "Vector"}, "Vector", partial(_band, n))
    for n in (1, 2, 3)
)


POINT_MATERIAL = "STGA Points"
GAUSSIAN_MATERIAL = "STGA Gaussians"
DISPLAY_COLOR = "stga_display_color"  # attribute that the splat nodes store
DISK = 0.7
"""Radius of the disk that an octahedron of radius 1 shows whole."""
DOT_SIZE = 1.8
"""Radius of a dot in mean standard deviations, at which dots leave no holes."""
EXTENT = 3.0
"""Standard deviations from a quad's center to its sides; a Gaussian is below 1.2 % there."""


def _splat_material(name: str, build: Callable[[Nodes], Any], method: str) -> bpy.types.Material:
    """Built where the file has none; method: EEVEE's, "DITHERED" or "BLENDED"."""
    material = bpy.data.materials.get(name)
    if material is None:
        material = new_material(name, build)
        material.surface_render_method = method
        material.use_backface_culling = True
    return material


def _point_shader(nodes: Nodes) -> Any:
    """Emits the colors of points; cuts disks out of the octahedra around them that EEVEE draws."""
    color, opacity = _color_and_opacity(nodes, "GEOMETRY")
    kinds = "ShaderNodeNewGeometry", "ShaderNodePointInfo"
    geometry, point = (nodes.add(kind).outputs for kind in kinds)
    offset = nodes.vector("SUBTRACT", geometry["Position"], point["Position"])
    along = nodes.vector("DOT_PRODUCT", offset, geometry["Incoming"])
    length2 = nodes.vector("DOT_PRODUCT", offset, offset)
    distance2 = nodes.math("SUBTRACT", length2, nodes.math("MULTIPLY", along, along))
    limit = nodes.math("MULTIPLY", point["Radius"], DISK)
    inside = nodes.math("LESS_THAN", distance2, nodes.math("MULTIPLY", limit, limit))
    return _emission(nodes, color, nodes.math("MULTIPLY", opacity, inside))


def _gaussian_shader(nodes: Nodes) -> Any:
    """Renders instances of a quad as Gaussians; the instance's scale is the standard deviation.

    Along a ray with unit direction D through a point P of the quad, both in the instance's space,
    the Gaussian is densest where the ray is nearest to the center, at the squared distance |P|² −
    (P·D)²; its density there is taken for the whole splat. Exact for Cycles up to the order of
    overlapping splats, and for EEVEE up to their order by centers.
    """
    color, opacity = _color_and_opacity(nodes, "INSTANCER")
    geometry = nodes.add("ShaderNodeNewGeometry").outputs
    position = nodes.add("ShaderNodeTexCoord").outputs["Object"]
    to_object = {"vector_type": "VECTOR", "convert_from": "WORLD", "convert_to": "OBJECT"}
    ray = nodes.out("ShaderNodeVectorTransform", {"Vector": geometry["Incoming"]}, **to_object)
    along = nodes.vector("DOT_PRODUCT", position, nodes.vector("NORMALIZE", ray))
    length2 = nodes.vector("DOT_PRODUCT", position, position)
    distance2 = nodes.math("SUBTRACT", length2, nodes.math("MULTIPLY", along, along))
    density = nodes.math("EXPONENT", nodes.math("MULTIPLY", distance2, -0.5))
    # Whatever is behind a quad sees through it.
    front = nodes.math("SUBTRACT", 1.0, geometry["Backfacing"])
    visible = nodes.math("MULTIPLY", density, front)
    return _emission(nodes, color, nodes.math("MULTIPLY", visible, opacity))


def _color_and_opacity(nodes: Nodes, attribute_type: str) -> tuple[Any, Any]:
    """What the splat nodes stored on points ("GEOMETRY") or instances ("INSTANCER")."""
    color, opacity = (
        nodes.add("ShaderNodeAttribute", attribute_type=attribute_type, attribute_name=name).outputs
        for name in (DISPLAY_COLOR, OPACITY)
    )
    return color["Color"], opacity["Fac"]


def _emission(nodes: Nodes, color: Any, alpha: Any) -> Any:
    shaders = [nodes.out("ShaderNodeBsdfTransparent")]
    shaders.append(nodes.out("ShaderNodeEmission", {"Color": color}))
    return nodes.out("ShaderNodeMixShader", {"Fac": alpha, "Shader": shaders})


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
    AS_TRAINED: "Exact in viewports and by the engine STGA Splats; "
    "EEVEE and Cycles render camera quads",
    POINTS: "Fast: a dot for each splat, in one color; for Material Preview",
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
    choice = {"Switch": nodes.out("GeometryNodeIsViewport"), "False": made[QUADS]}
    in_images = nodes.out("GeometryNodeSwitch", choice, input_type="GEOMETRY")
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
    # A point has one radius.
    scale = nodes.attribute(WORLD_SCALE, "FLOAT_VECTOR")
    mean = nodes.vector("DOT_PRODUCT", scale, (DOT_SIZE / DISK / 3,) * 3)
    inputs = {"Mesh": splats, "Selection": visible, "Radius": nodes.math("MULTIPLY", mean, size)}
    points = nodes.out("GeometryNodeMeshToPoints", inputs)
    # EEVEE does not sort the points of a point cloud.
    material = _splat_material(POINT_MATERIAL, _point_shader, "DITHERED")
    return nodes.out("GeometryNodeSetMaterial", {"Geometry": points, "Material": material})


def _quads(nodes: Nodes, splats: Any, visible: Any, size: Any) -> bpy.types.NodeSocket:
    """Two triangles per splat, which cover its ellipsoid as the scene's active camera sees it.

    In the ellipsoid's own space it is a sphere, and the quad faces the camera there. Instances:
    realizing them would take twenty times as long.
    """
    sides = {"Size X": 2 * EXTENT, "Size Y": 2 * EXTENT, "Vertices X": 2, "Vertices Y": 2}
    quad = nodes.out("GeometryNodeMeshGrid", sides)
    # EEVEE sorts instances: no noise. Stochastic transparency takes hundreds of samples to come
    # as close.
    material = _splat_material(GAUSSIAN_MATERIAL, _gaussian_shader, "BLENDED")
    quad = nodes.out("GeometryNodeSetMaterial", {"Geometry": quad, "Material": material})
    points = {"Points": splats, "Selection": visible, "Instance": quad}
    quads = nodes.out("GeometryNodeInstanceOnPoints", points)
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
    placed = {"Instances": quads}
    placed["Transform"] = nodes.out("FunctionNodeMatrixMultiply", {"Matrix": transforms})
    return nodes.out("GeometryNodeSetInstanceTransform", placed)


def _native(
    degree: int, nodes: Nodes, splats: Any, visible: Any, size: Any, color: Any,
    view_dependent: Any, gray: Any,
) -> bpy.types.NodeSocket:  # fmt: skip
    """Points with what native splats are drawn from: harmonics have the object's axes, in which
    they were trained.

    color: constant part, sRGB; gray: splats in one color, DISPLAY_COLOR, as are those that are
    relit.
    """
    _, is_relit = nodes.attribute_if_any(RELIT_COLOR, "FLOAT_COLOR")
    flat = nodes.logic("OR", gray, is_relit)
    shown = nodes.group(LINEAR_TO_SRGB, nodes.attribute(DISPLAY_COLOR, "FLOAT_COLOR"))
    color = nodes.vector("SUBTRACT", nodes.switch("VECTOR", flat, color, shown), (0.5, 0.5, 0.5))
    red, green, blue = nodes.components(nodes.scale(color, 1 / SH_C0))
    base = {"Red": red, "Green": green, "Blue": blue, "Alpha": nodes.attribute(OPACITY, "FLOAT")}
    # A color, which 5.3 draws as four floats; of FLOAT4, this node of 5.2 stores three.
    radiance = nodes.out("FunctionNodeCombineColor", base)
    splats = nodes.store(splats, RADIANCE, radiance, "FLOAT_COLOR")
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
_NATIVE_INPUTS = _INPUTS | {"Color": "Vector", "View-Dependent": "Bool", "Gray": "Bool"}
NATIVE_GROUPS = tuple(
    NodeGroup(f"STGA Native Splats {n}", _NATIVE_INPUTS, "Geometry", partial(_native, n))
    for n in range(4)
)
"""By the harmonics' degree."""
