"""The geometry node tree that displays splats: colors, display modes and materials. For splats that
follow a head it computes each triangle's frame on the *evaluated* mesh."""

from functools import cached_property, partial
from typing import Any, NamedTuple

from ...avatar.offsets import COLOR, OFFSETS
from ...avatar.splats import SH_C0, harmonics
from ...capture.meshes import SELECTED_WEIGHT
from .. import compat, tags
from ..layers import FROZEN_COLOR, UNSEEN_COLOR
from . import splat_attributes as stored
from .frame_nodes import (
    DEFORMED,
    FACE_COLOR,
    FOLLOWING,
    FRAMES,
    PLACED,
    POSED,
    SIGNALS,
    driven,
)
from .lit_nodes import LIGHTS, LIT, RECORDED, SCENE_LIGHT, SURFACE
from .node_builder import (
    NodeGroup,
    Nodes,
    Socket,
    Tree,
    find_tree,
    kept_material,
    new_socket,
    new_tree,
)

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
SHOW_UNSEEN = "Show Unseen"
FILMED_ONLY = "Filmed Only"
NATIVE_LIGHT = "Native Light"


def constant_color(nodes: Nodes, added: Any) -> Any:
    """The part of each splat's sRGB color, not clamped, that does not depend on the view. added:
    the color of its triangle, None where nothing drives colors."""
    color = nodes.scale(nodes.attribute(stored.SH.format(0)), SH_C0)
    return nodes.sum(color, (0.5, 0.5, 0.5), *(() if added is None else (added,)))


def _srgb_to_linear(nodes: Nodes, srgb: Any) -> Any:
    """Scene-linear color of sRGB, clamped to 0…1 (IEC 61966-2-1)."""
    clamped = nodes.vector("MINIMUM", nodes.vector("MAXIMUM", srgb, (0, 0, 0)), (1, 1, 1))
    linear = []
    for value in nodes.components(clamped):
        base = nodes.math("DIVIDE", nodes.math("ADD", value, 0.055), 1.055)
        line = nodes.math("DIVIDE", value, 12.92)
        power = nodes.math("POWER", base, 2.4)
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

    def __init__(self, nodes: Nodes, operation: str = "", *values: Any) -> None:
        self._nodes = nodes
        self._operation = operation
        self._values = values

    @cached_property
    def socket(self) -> Any:
        values = [each.socket if isinstance(each, _Formula) else each for each in self._values]
        return self._nodes.math(self._operation, *values)

    def __mul__(self, other: Any) -> "_Formula":
        return _Formula(self._nodes, "MULTIPLY", self, other)

    def __sub__(self, other: Any) -> "_Formula":
        return _Formula(self._nodes, "SUBTRACT", self, other)

    __rmul__ = __mul__


def _band(degree: int, nodes: Nodes, direction: Any) -> Any:
    """Sum of the coefficients of one degree times their harmonics in a unit direction."""
    axes = _Formula(nodes), _Formula(nodes), _Formula(nodes)
    for axis, component in zip(axes, nodes.components(direction), strict=True):
        axis.socket = component
    total = (0, 0, 0)
    terms = harmonics(*axes)
    for index in range(degree**2, (degree + 1) ** 2):
        coefficient = nodes.attribute(stored.SH.format(index))
        total = nodes.vector("MULTIPLY_ADD", coefficient, terms[index].socket, total)
    return total


SRGB_TO_LINEAR = NodeGroup("STGA sRGB to Linear", {"sRGB": "Vector"}, "Color", _srgb_to_linear)
"""Vector in sRGB -> linear color."""
LINEAR_TO_SRGB = NodeGroup("STGA Linear to sRGB", {"Color": "Color"}, "Vector", _linear_to_srgb)
"""Linear color from 0 on -> vector in sRGB."""
SH_BANDS = tuple(
    NodeGroup(f"STGA Spherical Harmonics {n}", {"Direction": "Vector"}, "Vector", partial(_band, n))
    for n in (1, 2, 3)
)
"""Unit direction -> sum of the coefficients of degree 1, 2 or 3 times their harmonics."""


DISK = 0.7
"""Radius of the disk that an octahedron of radius 1 shows whole."""
DOT_SIZE = 1.8
"""Radius of a dot in mean standard deviations, at which dots leave no holes."""
EXTENT = 3.0
"""Standard deviations from a quad's center to its sides; a Gaussian is below 1.2 % there."""


def _point_shader(nodes: Nodes) -> Any:
    """Emits the colors of points; cuts disks out of the octahedra around them that EEVEE draws."""
    geometry = nodes.add("ShaderNodeNewGeometry").outputs
    point = nodes.add("ShaderNodePointInfo").outputs
    offset = nodes.vector("SUBTRACT", geometry["Position"], point["Position"])
    distance2 = _squared_distance(nodes, offset, geometry["Incoming"])
    limit = nodes.math("MULTIPLY", point["Radius"], DISK)
    inside = nodes.math("LESS_THAN", distance2, nodes.math("MULTIPLY", limit, limit))
    return _emission(nodes, "GEOMETRY", inside)


def _gaussian_shader(nodes: Nodes) -> Any:
    """Renders instances of a quad as Gaussians; the instance's scale is the standard deviation.
    Along a ray in unit direction D through a point P of the quad, in the instance's space, the
    Gaussian is densest at the squared distance |P|² − (P·D)² from the center; that density is taken
    for the whole splat. Exact but for the order of overlapping splats (EEVEE's by centers)."""
    geometry = nodes.add("ShaderNodeNewGeometry").outputs
    position = nodes.add("ShaderNodeTexCoord").outputs["Object"]
    to_object = {"vector_type": "VECTOR", "convert_from": "WORLD", "convert_to": "OBJECT"}
    ray = nodes.out("ShaderNodeVectorTransform", {"Vector": geometry["Incoming"]}, **to_object)
    distance2 = _squared_distance(nodes, position, nodes.vector("NORMALIZE", ray))
    density = nodes.math("EXPONENT", nodes.math("MULTIPLY", distance2, -0.5))
    # Whatever is behind a quad sees through it.
    front = nodes.math("SUBTRACT", 1.0, geometry["Backfacing"])
    return _emission(nodes, "INSTANCER", nodes.math("MULTIPLY", density, front))


def _squared_distance(nodes: Nodes, point: Any, direction: Any) -> Any:
    """Squared distance of the origin from the line through a point in a unit direction."""
    along = nodes.vector("DOT_PRODUCT", point, direction)
    length2 = nodes.vector("DOT_PRODUCT", point, point)
    return nodes.math("SUBTRACT", length2, nodes.math("MULTIPLY", along, along))


def _emission(nodes: Nodes, attribute_type: str, density: Any) -> Any:
    """Light of the color and opacity that the splat nodes stored on points ("GEOMETRY") or
    instances ("INSTANCER"), times the density."""
    color = nodes.add("ShaderNodeAttribute")
    opacity = nodes.add("ShaderNodeAttribute")
    color.attribute_type = opacity.attribute_type = attribute_type
    color.attribute_name = stored.DISPLAY_COLOR
    opacity.attribute_name = stored.OPACITY
    shaders = [nodes.out("ShaderNodeBsdfTransparent")]
    shaders.append(nodes.out("ShaderNodeEmission", {"Color": color.outputs["Color"]}))
    alpha = nodes.math("MULTIPLY", opacity.outputs["Fac"], density)
    return nodes.out("ShaderNodeMixShader", {"Fac": alpha, "Shader": shaders})


AS_TRAINED = "As Trained"
"""Display that blends splats as training does: in viewports, and by the engine STGA Splats."""
POINTS = "Points"
"""Display as dots, one for each splat."""
QUADS = "Camera Quads"
"""Display as rectangles that face the scene's camera."""
NATIVE = "Native Splats"
"""Display as the splats that Blender has itself (`compat.NATIVE_SPLATS`)."""
LIMITS = {
    AS_TRAINED: "Exact in viewports and by the engine STGA Splats; "
    "EEVEE and Cycles render camera quads",
    POINTS: "Fast: a dot for each splat, in one color; for Material Preview",
    QUADS: "For EEVEE and Cycles; right through the scene's camera only",
    NATIVE: "Blender's own splats, for EEVEE and Cycles through any camera; "
    "edges are lighter than trained until Bake for Linear Blending fits the colors",
}
"""Display -> what it is for and what it is not, in its tooltip and in the panel."""


def displayed(nodes: Nodes, mode: Any, splats: Any, visible: Any, size: Any, native: Any) -> Any:
    """The splats in the display mode of the menu socket `mode`. visible: field, which splats; size:
    factor; native: splats from NATIVE_GROUPS, None in a Blender without native splats."""
    made = {name: nodes.group(group, splats, visible, size) for name, group in MODES.items()}
    # Nothing in viewports, where `viewport_display.py` draws; in images by EEVEE and Cycles, quads
    # that face the camera.
    choice = {"Switch": nodes.out("GeometryNodeIsViewport"), "False": made[QUADS]}
    in_images = nodes.out("GeometryNodeSwitch", choice, input_type="GEOMETRY")
    geometries = {AS_TRAINED: in_images, **made}
    if native is not None:
        geometries[NATIVE] = native
    return nodes.menu("GEOMETRY", mode, geometries, LIMITS)


def _points(nodes: Nodes, splats: Any, visible: Any, size: Any) -> Socket:
    # A point has one radius.
    scale = nodes.attribute(stored.WORLD_SCALE)
    mean = nodes.vector("DOT_PRODUCT", scale, (DOT_SIZE / DISK / 3,) * 3)
    inputs = {"Mesh": splats, "Selection": visible, "Radius": nodes.math("MULTIPLY", mean, size)}
    points = nodes.out("GeometryNodeMeshToPoints", inputs)
    # EEVEE does not sort the points of a point cloud.
    material = kept_material("STGA Points", _point_shader, "DITHERED")
    return nodes.out("GeometryNodeSetMaterial", {"Geometry": points, "Material": material})


def _quads(nodes: Nodes, splats: Any, visible: Any, size: Any) -> Socket:
    """Two triangles per splat, which cover its ellipsoid as the scene's camera sees it: in its own
    space, a sphere, the quad faces the camera. Instances: realizing them takes twenty times as
    long."""
    sides = {"Size X": 2 * EXTENT, "Size Y": 2 * EXTENT, "Vertices X": 2, "Vertices Y": 2}
    quad = nodes.out("GeometryNodeMeshGrid", sides)
    # EEVEE sorts instances: no noise. Stochastic transparency takes hundreds of samples to come
    # as close.
    material = kept_material("STGA Gaussians", _gaussian_shader, "BLENDED")
    quad = nodes.out("GeometryNodeSetMaterial", {"Geometry": quad, "Material": material})
    points = {"Points": splats, "Selection": visible, "Instance": quad}
    quads = nodes.out("GeometryNodeInstanceOnPoints", points)
    # Per splat: its ellipsoid's transform after a rotation that turns +Z to the active camera.
    position = nodes.out("GeometryNodeInputPosition")
    rotation = nodes.attribute(stored.WORLD_ROTATION, "QUATERNION")
    scale = nodes.scale(nodes.attribute(stored.WORLD_SCALE), size)
    camera = nodes.object_info(nodes.out("GeometryNodeInputActiveCamera")).outputs["Location"]
    inverse = nodes.out("FunctionNodeInvertRotation", {"Rotation": rotation})
    to_camera = nodes.vector("SUBTRACT", camera, position)
    to_camera = nodes.out("FunctionNodeRotateVector", {"Vector": to_camera, "Rotation": inverse})
    to_camera = nodes.vector("NORMALIZE", nodes.vector("DIVIDE", to_camera, scale))
    axes = {"Primary Axis": to_camera, "Secondary Axis": (1, 0, 0)}
    facing = nodes.out("FunctionNodeAxesToRotation", axes, primary_axis="Z", secondary_axis="X")
    ellipsoid = {"Translation": position, "Rotation": rotation, "Scale": scale}
    turn = {"Rotation": facing}
    both = [nodes.out("FunctionNodeCombineTransform", part) for part in (ellipsoid, turn)]
    transform = nodes.out("FunctionNodeMatrixMultiply", {"Matrix": both})
    placed = {"Instances": quads, "Transform": transform}
    return nodes.out("GeometryNodeSetInstanceTransform", placed)


MIN_BASE = (-0.5 / SH_C0,) * 3
"""Constant coefficients of black."""
MAX_BASE = (0.62 / SH_C0,) * 3
"""Constant coefficients a little brighter than white: EEVEE keeps 8 bits over the range of all
splats, which one of them may make wide."""


class _NativeInputs(NamedTuple):
    """Sockets of NATIVE_GROUPS. added: as of `constant_color`; view_dependent: whether harmonics
    are added; painted: splats in one color, DISPLAY_COLOR, as those that are relit."""

    splats: Any
    visible: Any
    size: Any
    added: Any
    view_dependent: Any
    painted: Any


def _radiance(nodes: Nodes, added: Any, flat: Any) -> Socket:
    """Field: constant coefficient and opacity of native splats, those fitted for linear light
    where there are any; flat: of the display color. As a color, which 5.3 draws as four floats; of
    FLOAT4, the node that stores it in 5.2 takes three."""
    fitted, is_fitted = nodes.attribute_if_any(stored.LINEAR_SH, "FLOAT_VECTOR")
    base = nodes.switch("VECTOR", is_fitted, nodes.attribute(stored.SH.format(0)), fitted)
    base = nodes.vector("MULTIPLY_ADD", added, (1 / SH_C0,) * 3, base)
    color = nodes.group(LINEAR_TO_SRGB, nodes.attribute(stored.DISPLAY_COLOR, "FLOAT_COLOR"))
    color = nodes.scale(nodes.vector("SUBTRACT", color, (0.5, 0.5, 0.5)), 1 / SH_C0)
    base = nodes.switch("VECTOR", flat, base, color)
    clamped = nodes.vector("MINIMUM", nodes.vector("MAXIMUM", base, MIN_BASE), MAX_BASE)
    red, green, blue = nodes.components(clamped)
    trained = nodes.attribute(stored.OPACITY, "FLOAT")
    fitted = nodes.attribute(stored.LINEAR_OPACITY, "FLOAT")
    alpha = nodes.switch("FLOAT", is_fitted, trained, fitted)
    parts = {"Red": red, "Green": green, "Blue": blue, "Alpha": alpha}
    return nodes.out("FunctionNodeCombineColor", parts)


_RADIANCE = NodeGroup("STGA Radiance", {"Added": "Vector", "Flat": "Bool"}, "Color", _radiance)


def _native(degree: int, nodes: Nodes, *sockets: Any) -> Socket:
    """Native splats with what they are drawn from alone, harmonics in the object's axes; sockets:
    as _NativeInputs."""
    given = _NativeInputs(*sockets)
    _, is_relit = nodes.attribute_if_any(stored.RELIT_COLOR, "FLOAT_COLOR")
    flat = nodes.logic("OR", given.painted, is_relit)
    radiance = nodes.group(_RADIANCE, given.added, flat)
    splats = nodes.store(given.splats, stored.RADIANCE, radiance, "FLOAT_COLOR")
    scale = nodes.scale(nodes.attribute(stored.WORLD_SCALE), given.size)
    splats = nodes.store(splats, stored.WORLD_SCALE, scale, "FLOAT_VECTOR")
    factor = nodes.logic("NIMPLY", given.view_dependent, flat)
    for index in range((degree + 1) ** 2 - 1):
        coefficient = nodes.scale(nodes.attribute(stored.SH.format(index + 1)), factor)
        splats = nodes.store(splats, stored.RADIANCE_SH.format(index), coefficient, "FLOAT_VECTOR")
    points = nodes.out("GeometryNodeMeshToPoints", {"Mesh": splats, "Selection": given.visible})
    return compat.native_splats(nodes.tree, points, "stga_*")


_INPUTS = {"Splats": "Geometry", "Visible": "Bool", "Size": "Float"}
"""Inputs of the groups in MODES -> their types."""
MODES = {
    POINTS: NodeGroup("STGA Points", _INPUTS, "Geometry", _points),
    QUADS: NodeGroup("STGA Camera Quads", _INPUTS, "Geometry", _quads),
}
"""Display of any Blender -> node group that makes its geometry."""
_NATIVE_INPUTS = _INPUTS | {"Added": "Vector", "View-Dependent": "Bool", "Painted": "Bool"}
"""Inputs of NATIVE_GROUPS, as in _NativeInputs -> their types."""
NATIVE_GROUPS = tuple(
    NodeGroup(f"STGA Native Splats {n}", _NATIVE_INPUTS, "Geometry", partial(_native, n))
    for n in range(4)
)
"""Node groups of native splats by the harmonics' degree."""


_FROZEN = "stga_frozen"
"""Attribute of splats on triangles that the frame's selection leaves out."""
MENUS = {DISPLAY: AS_TRAINED, NATIVE_LIGHT: RECORDED}
"""Inputs that are menus -> what is chosen in a new file."""


class TreeOptions(NamedTuple):
    """What a node tree depends on: the embedding's convention (None: world space), degree of
    harmonics, and the driven offsets, names of OFFSETS in its order."""

    convention: str | None
    degree: int = 0
    offsets: tuple[str, ...] = ()

    @property
    def signals(self) -> list[str]:
        """What drives the offsets, each once."""
        return list(dict.fromkeys(OFFSETS[name].signal for name in self.offsets))

    @property
    def is_colored(self) -> bool:
        """Whether an offset drives colors."""
        return any(OFFSETS[name].target == COLOR for name in self.offsets)

    @property
    def tree_name(self) -> str:
        """At most 59 characters: Blender before 5.0 has room for 63, and may add ".001". Of
        offsets, the words' initials."""
        parts = [self.convention or "world", f"SH {self.degree}"]
        initials = ("".join(word[0] for word in name.split("_")) for name in self.offsets)
        parts += [" ".join(initials)] if self.offsets else []
        return f"STGA Splats ({', '.join(parts)})"


def splat_tree(options: TreeOptions) -> Tree:
    """The node tree for splats of this kind. Built once per file."""
    tree = find_tree(options.tree_name)
    if tree is None:
        tree = new_tree(options.tree_name)
        tree.is_modifier = True
        _add_interface(tree, options.convention is not None, options.degree)
        _build(Nodes(tree), options)
    return tree


def build_next_node_group(options: TreeOptions) -> bool:
    """Build one node group that `splat_tree` needs, itself last; False if all exist: called from a
    timer, it keeps the UI responsive."""
    if find_tree(options.tree_name) is not None:
        return False
    convention, degree, offsets = options
    # What `_build` uses, each after those that it uses itself.
    groups = [PLACED[convention], _RELIT, *MODES.values(), *SH_BANDS[:degree]]
    if convention is not None:
        groups += [FRAMES[convention], _FROZEN_SPLATS, _MARKED, _PAINT]
        groups += [POSED, FOLLOWING, *([DEFORMED] if offsets else [])]
        groups += [SIGNALS[name] for name in options.signals]
        groups += [driven(name, convention) for name in offsets]
    if degree > 0 or options.is_colored:
        groups.append(SRGB_TO_LINEAR)
    if compat.NATIVE_SPLATS:
        groups += [LINEAR_TO_SRGB, _RADIANCE, NATIVE_GROUPS[degree]]
        groups += [] if convention is None else [SURFACE, LIT]
    missing = next((group for group in groups if find_tree(f".{group.name}") is None), None)
    if missing is None:
        splat_tree(options)
    else:
        missing.tree()
    return True


def _add_interface(tree: Tree, embedded: bool, degree: int) -> None:
    def add(name: str, kind: str, description: str, **properties: Any) -> None:
        socket = new_socket(tree, name, "INPUT", kind)
        for key, value in {"description": description, **properties}.items():
            setattr(socket, key, value)

    new_socket(tree, "Geometry", "OUTPUT", "Geometry")
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
    unseen = "splats that no camera saw, which are plausible only"
    flags = {
        SHOW_SELECTION: f"Gray out {frozen}",
        SELECTED_ONLY: f"Hide {frozen}",
        SHOW_UNSEEN: f"Color {unseen}, blue",
        FILMED_ONLY: f"Hide {unseen}",
    }
    for name, description in flags.items() if embedded else ():
        add(name, "Bool", description, default_value=False)
    if embedded and compat.NATIVE_SPLATS:
        add(NATIVE_LIGHT, "Menu", "Light that native splats show in EEVEE and Cycles")


def _build(nodes: Nodes, options: TreeOptions) -> None:
    inputs = nodes.add("NodeGroupInput").outputs
    splats = inputs["Geometry"]
    opacity = nodes.attribute(stored.OPACITY, "FLOAT")
    threshold = inputs[OPACITY_THRESHOLD]
    opaque = nodes.compare("GREATER_EQUAL", opacity, threshold)
    # Above 0 so that 0 % shows nothing, up to 100 so that 100 % shows all.
    random = nodes.out("FunctionNodeRandomValue", {"Min": 1e-6, "Max": 100.0}, data_type="FLOAT")
    visible = nodes.logic("AND", opaque, nodes.compare("LESS_EQUAL", random, inputs[PERCENTAGE]))
    added = None
    painted = False
    if options.convention is None:
        splats = nodes.group(PLACED[None], splats)
        color = _color(nodes, inputs, None, options.degree)
    else:
        head = nodes.object_info(inputs[HEAD]).outputs["Geometry"]
        neutral = nodes.object_info(inputs[NEUTRAL], "ORIGINAL").outputs["Geometry"]
        splats = nodes.group(FOLLOWING, splats, head, neutral)
        mesh = nodes.group(DEFORMED if options.offsets else POSED, head, neutral)
        for name in options.signals:
            mesh = nodes.group(SIGNALS[name], mesh)
        mesh = nodes.group(FRAMES[options.convention], mesh)
        for name in options.offsets:
            mesh = nodes.group(driven(name, options.convention), mesh)
        splats = nodes.group(PLACED[options.convention], splats, mesh)
        if options.is_colored:
            face = nodes.attribute(stored.FACE, "INT")
            added = nodes.sample(mesh, nodes.attribute(FACE_COLOR), face, "FLOAT_VECTOR")
        color = _color(nodes, inputs, added, options.degree)
        splats = nodes.store(splats, _FROZEN, nodes.group(_FROZEN_SPLATS, head), "BOOLEAN")
        painted = nodes.group(_MARKED, inputs[SHOW_SELECTION], inputs[SHOW_UNSEEN])
        paint = nodes.group(_PAINT, inputs[SHOW_UNSEEN])
        color = nodes.switch("RGBA", painted, color, paint)
        hidden = nodes.group(_MARKED, inputs[SELECTED_ONLY], inputs[FILMED_ONLY])
        visible = nodes.logic("NIMPLY", visible, hidden)
    splats = nodes.store(splats, stored.DISPLAY_COLOR, nodes.group(_RELIT, color), "FLOAT_COLOR")
    native = None
    if compat.NATIVE_SPLATS:
        view_dependent = inputs[VIEW_DEPENDENT] if options.degree > 0 else False
        fields = inputs[SIZE], (0, 0, 0) if added is None else added, view_dependent, painted
        lit = given = None
        if options.convention is not None:
            choices = {RECORDED: False, SCENE_LIGHT: True}
            lit = nodes.menu("BOOLEAN", inputs[NATIVE_LIGHT], choices, LIGHTS)
            given = nodes.switch("GEOMETRY", lit, splats, nodes.group(SURFACE, splats, mesh))
        native = nodes.group(NATIVE_GROUPS[options.degree], given or splats, visible, *fields)
        if lit is not None:
            native = nodes.switch("GEOMETRY", lit, native, nodes.group(LIT, native, head))
    geometry = displayed(nodes, inputs[DISPLAY], splats, visible, inputs[SIZE], native)
    nodes.finish("NodeGroupOutput", {"Geometry": geometry})
    for item in nodes.tree.interface.items_tree:  # a menu has items only once it is linked
        if item.name in MENUS:
            item.default_value = MENUS[item.name]


def _color(nodes: Nodes, inputs: Any, added: Any, degree: int) -> Any:
    """Scene-linear color of each splat; added: as of `constant_color`."""
    color = nodes.attribute(stored.COLOR, "FLOAT_COLOR")
    if added is None and degree == 0:
        return color
    srgb = constant_color(nodes, added)
    if added is not None:
        color = nodes.group(SRGB_TO_LINEAR, srgb)
    if degree == 0:
        return color
    # In the space that splats were trained in.
    camera = nodes.object_info(nodes.out("GeometryNodeInputActiveCamera")).outputs["Location"]
    position = nodes.out("GeometryNodeInputPosition")
    direction = nodes.vector("NORMALIZE", nodes.vector("SUBTRACT", position, camera))
    view_dependent = nodes.sum(srgb, *(nodes.group(band, direction) for band in SH_BANDS[:degree]))
    # Without a camera object the location is zero, which is inside the head: no camera is there.
    has_camera = nodes.compare("GREATER_THAN", nodes.vector("LENGTH", camera), 0.0)
    is_chosen = nodes.logic("AND", inputs[VIEW_DEPENDENT], has_camera)
    return nodes.switch("RGBA", is_chosen, color, nodes.group(SRGB_TO_LINEAR, view_dependent))


def _frozen_splats(nodes: Nodes, mesh: Any) -> Socket:
    """Field: splats on triangles that the frame's selection, if there is one, leaves out."""
    time = nodes.add("GeometryNodeInputSceneTime").outputs["Frame"]
    frame = nodes.out("FunctionNodeValueToString", {"Value": time})
    parts = {"String": f"{tags.GROUP_PREFIX}#", "Find": "#", "Replace": frame}
    name = nodes.out("FunctionNodeReplaceString", parts)
    weight, exists = nodes.attribute_if_any(name, "FLOAT")
    selected = nodes.compare("GREATER_EQUAL", weight, SELECTED_WEIGHT)
    # On the points: a boolean is true on a face where it is true at all the face's points.
    frozen = nodes.logic("NIMPLY", exists, nodes.at_points(selected, "BOOLEAN"))
    return nodes.sample(mesh, frozen, nodes.attribute(stored.FACE, "INT"), "BOOLEAN")


_FROZEN_SPLATS = NodeGroup("STGA Frozen Splats", {"Mesh": "Geometry"}, "Bool", _frozen_splats)


def _marked(nodes: Nodes, frozen: Any, unseen: Any) -> Socket:
    """Field: splats of those kinds that are asked for."""
    kinds = (_FROZEN, frozen), (stored.UNSEEN, unseen)
    found = [nodes.logic("AND", nodes.attribute(name, "BOOLEAN"), asked) for name, asked in kinds]
    return nodes.logic("OR", *found)


def _paint(nodes: Nodes, shows_unseen: Any) -> Socket:
    """Field: the color of a marked splat; unseen ones have theirs where it is shown."""
    unseen = nodes.logic("AND", nodes.attribute(stored.UNSEEN, "BOOLEAN"), shows_unseen)
    return nodes.switch("RGBA", unseen, FROZEN_COLOR, UNSEEN_COLOR)


_MARKED = NodeGroup("STGA Marked Splats", {"Frozen": "Bool", "Unseen": "Bool"}, "Bool", _marked)
_PAINT = NodeGroup("STGA Paint", {"Shows Unseen": "Bool"}, "Color", _paint)


def _relit_color(nodes: Nodes, color: Any) -> Socket:
    """Field: the relit color of a frame where the splats have one, else `color`."""
    relit, exists = nodes.attribute_if_any(stored.RELIT_COLOR, "FLOAT_COLOR")
    return nodes.switch("RGBA", exists, color, relit)


_RELIT = NodeGroup("STGA Relit Color", {"Color": "Color"}, "Color", _relit_color)
