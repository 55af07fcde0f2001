"""Node groups that compute triangles' frames on the head and what drives their splats, and place
splats by them."""

from collections.abc import Callable, Iterable
from functools import cache, partial, reduce
from typing import Any

from ...avatar.embedding import CONVENTIONS, MIN_AREA_RATIO, UPRIGHT_COSINE
from ...avatar.offsets import COLOR, OFFSETS, SCALE
from ...avatar.strain import AVERAGING_ROUNDS, MIN_SQUARED_NORMAL, STRAIN_COMPONENTS, STRAIN_GAIN
from .. import compat
from . import splat_attributes as stored
from .node_builder import NodeGroup, Nodes, Socket

MAX_AREA_RATIO = 4.0
"""Largest ratio of the area of the splats' triangles to that of the evaluated head, for which the
head's first vertices are those of the splats; in a remeshed head they are anywhere."""

# Temporary attributes on the head's faces.
_FRAME_ORIGIN = "stga_frame_origin"
_FRAME_ROTATION = "stga_frame_rotation"
_FRAME_SIZE = "stga_frame_size"


def _stored_frames(convention: str, nodes: Nodes, mesh: Any) -> Any:
    """The mesh with each triangle's frame stored on its faces."""
    # Sampling a stored attribute is fast; sampling a field would evaluate it once per splat.
    p0, p1, p2 = nodes.triangle_corners()
    origin = nodes.scale(nodes.sum(p0, p1, p2), 1 / 3)
    edge = nodes.vector("SUBTRACT", p1, p0)
    side = nodes.vector("SUBTRACT", p2, p0)
    if convention == "stga":  # axes [n(p0−o), ·, normal], o being the centroid
        # p0 − origin from the edges: exactly zero where the corners coincide, which a difference
        # to a rounded mean is not.
        first = nodes.scale(nodes.vector("ADD", edge, side), -1 / 3)
        rotation, normal, _ = _axes_to_rotation(nodes, first, edge, side, "Z")
        size = nodes.math("MULTIPLY", nodes.vector("LENGTH", normal), 0.5)
    else:  # axes [n(p1−p0), normal, ·]
        rotation, normal, no_edge = _axes_to_rotation(nodes, edge, edge, side, "Y")
        # Height over the edge = |edge × side| / |edge|, or the side where the edge has no length.
        length = nodes.vector("LENGTH", edge)
        height = nodes.math("DIVIDE", nodes.vector("LENGTH", normal), length)
        height = nodes.switch("FLOAT", no_edge, height, nodes.vector("LENGTH", side))
        size = nodes.math("MULTIPLY", nodes.math("ADD", length, height), 0.5)
    mesh = nodes.store(mesh, _FRAME_ORIGIN, origin, "FLOAT_VECTOR", "FACE")
    mesh = nodes.store(mesh, _FRAME_ROTATION, rotation, "QUATERNION", "FACE")
    return nodes.store(mesh, _FRAME_SIZE, size, "FLOAT", "FACE")


def _in_space(nodes: Nodes, frame: Callable[..., Any], vector: Any, convention: str) -> Any:
    """A vector of a frame's own axes and unit in object space, the frame's rotation and its scale.
    frame: name and data type -> the frame's attribute."""
    scale = frame(_FRAME_SIZE, "FLOAT")
    turn = frame(_FRAME_ROTATION, "QUATERNION")
    if convention == "stga":  # by the triangle's area, and that of the neutral one
        neutral = nodes.attribute(stored.NEUTRAL_AREA, "FLOAT")
        ratio = nodes.math("SQRT", nodes.math("DIVIDE", scale, neutral))
        # A neutral triangle without area gives no ratio: its splats keep their size.
        has_area = nodes.compare("GREATER_THAN", neutral, 0.0)
        scale = nodes.switch("FLOAT", has_area, 1.0, ratio)
    local = {"Vector": nodes.scale(vector, scale), "Rotation": turn}
    return nodes.out("FunctionNodeRotateVector", local), turn, scale


def _placed_splats(convention: str | None, nodes: Nodes, splats: Any, mesh: Any = None) -> Any:
    """Splats placed in object space, rotation and scale stored; mesh: from `_stored_frames`."""
    xyz = nodes.attribute(stored.XYZ)
    rotation = nodes.attribute(stored.ROTATION, "QUATERNION")
    scale = nodes.attribute(stored.SCALE)
    if convention is not None:
        face = nodes.attribute(stored.FACE, "INT")

        def sample(name: str, data_type: str) -> Any:  # of each splat's triangle
            return nodes.sample(mesh, nodes.attribute(name, data_type), face, data_type)

        turned, turn, size = _in_space(nodes, sample, xyz, convention)
        xyz = nodes.vector("ADD", turned, sample(_FRAME_ORIGIN, "FLOAT_VECTOR"))
        rotations = {"Rotation": rotation, "Rotate By": turn}
        rotation = nodes.out("FunctionNodeRotateRotation", rotations, rotation_space="GLOBAL")
        scale = nodes.scale(scale, size)
    splats = nodes.out("GeometryNodeSetPosition", {"Geometry": splats, "Position": xyz})
    splats = nodes.store(splats, stored.WORLD_ROTATION, rotation, "QUATERNION")
    return nodes.store(splats, stored.WORLD_SCALE, scale, "FLOAT_VECTOR")


def _axes_to_rotation(
    nodes: Nodes, first: Any, edge: Any, side: Any, normal_axis: str
) -> tuple[Socket, Socket, Socket]:
    """Rotation with the x axis `first` of a triangle with two edges, its normal (its length twice
    the area), and whether `first` is degenerate: it and the normal then take the substitutes of
    `avatar.embedding`."""
    normal = nodes.vector("CROSS_PRODUCT", edge, side)
    edges = edge, side, nodes.vector("SUBTRACT", edge, side)
    longest = reduce(partial(nodes.math, "MAXIMUM"), [nodes.vector("LENGTH", v) for v in edges])
    limit = nodes.math("MULTIPLY", longest, MIN_AREA_RATIO)
    no_first = nodes.compare("LESS_EQUAL", nodes.vector("LENGTH", first), limit)
    limit = nodes.math("MULTIPLY", nodes.math("MULTIPLY", longest, longest), 2 * MIN_AREA_RATIO)
    no_normal = nodes.compare("LESS_EQUAL", nodes.vector("LENGTH", normal), limit)
    first = nodes.switch("VECTOR", no_first, nodes.vector("NORMALIZE", first), (1, 0, 0))
    z = nodes.math("ABSOLUTE", nodes.vector("DOT_PRODUCT", first, (0, 0, 1)))
    is_upright = nodes.compare("GREATER_THAN", z, UPRIGHT_COSINE)
    helper = nodes.switch("VECTOR", is_upright, (0, 0, 1), (1, 0, 0))
    second = nodes.vector("CROSS_PRODUCT", first, helper)
    second = nodes.switch("VECTOR", no_normal, nodes.vector("NORMALIZE", normal), second)
    axes = {"Primary Axis": first, "Secondary Axis": second}
    names = {"primary_axis": "X", "secondary_axis": normal_axis}
    return nodes.out("FunctionNodeAxesToRotation", axes, **names), normal, no_first


def _meshes(name: str, build: Callable[..., Any], *inputs: str) -> NodeGroup:
    """A group from geometries to a geometry."""
    return NodeGroup(f"STGA {name}", dict.fromkeys(inputs, "Geometry"), "Geometry", build)


FRAMES = {
    name: _meshes(f"Triangle Frames ({name})", partial(_stored_frames, name), "Mesh")
    for name in CONVENTIONS
}
"""Head mesh -> the mesh with frames, by convention."""
PLACED: dict[str | None, NodeGroup] = {
    name: _meshes(f"Place Splats ({name})", partial(_placed_splats, name), "Splats", "Frames")
    for name in CONVENTIONS
}
"""Splats (and the mesh with frames) -> splats in object space; None: in world space."""
PLACED[None] = _meshes("Place Splats (world)", partial(_placed_splats, None), "Splats")


# Temporary attributes on the faces of the deformed neutral mesh.
_GRAM_CHANGE = "stga_gram_change"
_SIGNAL = "stga_signal_{}"  # by name
FACE_COLOR = "stga_face_color"  # sRGB, added to the colors of a triangle's splats


def _moved_neutral(nodes: Nodes, posed: Any, neutral: Any) -> Any:
    """The neutral mesh at the posed vertices; of a subdivided mesh, the first are the original."""
    position = nodes.out("GeometryNodeInputPosition")
    index = nodes.out("GeometryNodeInputIndex")
    moved = nodes.sample(posed, position, index, "FLOAT_VECTOR", "POINT")
    return nodes.out("GeometryNodeSetPosition", {"Geometry": neutral, "Position": moved})


def _count(nodes: Nodes, mesh: Any, of: str) -> Any:
    """ "Face Count" or "Point Count" of a mesh."""
    size = nodes.add("GeometryNodeAttributeDomainSize", {"Geometry": mesh}, component="MESH")
    return size.outputs[of]


def _posed(nodes: Nodes, head: Any, neutral: Any) -> Any:
    """The head with the faces that splats are bound to, also where it is subdivided."""
    faces = [_count(nodes, mesh, "Face Count") for mesh in (head, neutral)]
    differs = nodes.compare("NOT_EQUAL", *faces)
    is_known = nodes.compare("GREATER_THAN", faces[1], 0.0)
    moved = _moved_neutral(nodes, head, neutral)
    return nodes.switch("GEOMETRY", nodes.logic("AND", differs, is_known), head, moved)


def _following(nodes: Nodes, splats: Any, head: Any, neutral: Any) -> Any:
    """The splats; none where the head has lost the vertices that they are bound to."""
    points = [_count(nodes, mesh, "Point Count") for mesh in (head, neutral)]
    areas = []
    for mesh in (nodes.group(POSED, head, neutral), head):
        inputs = {"Geometry": mesh, "Attribute": nodes.out("GeometryNodeInputMeshFaceArea")}
        statistic = nodes.add("GeometryNodeAttributeStatistic", inputs, domain="FACE")
        areas.append(
            next(each for each in statistic.outputs if each.enabled and each.name == "Sum")
        )
    most = nodes.math("MULTIPLY", areas[1], MAX_AREA_RATIO)
    is_torn = nodes.compare("GREATER_THAN", areas[0], most)
    is_lost = nodes.logic("OR", nodes.compare("LESS_THAN", *points), is_torn)
    if compat.WARNING_NODE:
        message = "The head has other triangles than its splats; check its modifiers"
        inputs = {"Show": is_lost, "Message": message}
        is_lost = nodes.out("GeometryNodeWarning", inputs, warning_type="ERROR")
    return nodes.out(
        "GeometryNodeSwitch", {"Switch": is_lost, "False": splats}, input_type="GEOMETRY"
    )


def _deformed(nodes: Nodes, posed: Any, neutral: Any) -> Any:
    """`_moved_neutral` with deformation tensors (`avatar.strain`)."""
    mesh = _moved_neutral(nodes, posed, neutral)
    p0, p1, p2 = nodes.triangle_corners()
    e1 = nodes.vector("SUBTRACT", p1, p0)
    e2 = nodes.vector("SUBTRACT", p2, p0)
    products = (nodes.vector("DOT_PRODUCT", a, b) for a, b in ((e1, e1), (e1, e2), (e2, e2)))
    rest = nodes.attribute(stored.GRAM)
    change = nodes.vector("SUBTRACT", nodes.combine(*products), rest)
    mesh = nodes.store(mesh, _GRAM_CHANGE, change, "FLOAT_VECTOR", "FACE")
    changes = nodes.components(nodes.attribute(_GRAM_CHANGE))
    for half in stored.TENSOR_HALVES:
        tensor = _weighted(nodes, [stored.TENSOR.format(k, half) for k in range(3)], changes)
        mesh = nodes.store(mesh, half, tensor, "FLOAT_VECTOR", "FACE")
    return mesh


def _weighted(nodes: Nodes, names: Iterable[str], factors: Iterable[Any]) -> Any:
    """Sum of vector attributes times numbers."""
    vectors = (nodes.attribute(name) for name in names)
    return nodes.sum(*(nodes.scale(v, by) for v, by in zip(vectors, factors, strict=True)))


def _strain_from_rest(nodes: Nodes) -> Any:
    """`avatar.strain.strain_from_rest` of the mesh from DEFORMED."""
    # Faces to points and back: the mean over the triangles that touch a triangle.
    tensors = [nodes.attribute(half) for half in stored.TENSOR_HALVES]
    means = [nodes.at_points(tensor, "FLOAT_VECTOR") for tensor in tensors]
    strains = []
    for index in range(STRAIN_COMPONENTS):
        products = []
        for half, mean in zip(stored.TENSOR_HALVES, means, strict=True):
            plane = nodes.attribute(stored.PLANE.format(index, half))
            products.append(nodes.vector("DOT_PRODUCT", mean, plane))
        strains.append(nodes.math("MULTIPLY", nodes.math("ADD", *products), STRAIN_GAIN))
    strain = _in_range(nodes, nodes.combine(*strains), stored.STRAIN_RANGE)
    return nodes.vector("SUBTRACT", strain, _in_range(nodes, (0, 0, 0), stored.STRAIN_RANGE))


def _with_smoothed_strain(nodes: Nodes, mesh: Any) -> Any:
    """The mesh from DEFORMED with `avatar.strain.smoothed_strain` stored."""
    # On faces, an iteration is the mean of a face and, by weight 1, those that share an edge.
    inputs = {"Value": _strain_from_rest(nodes), "Iterations": AVERAGING_ROUNDS, "Weight": 1.0}
    smoothed = nodes.out("GeometryNodeBlurAttribute", inputs, data_type="FLOAT_VECTOR")
    return nodes.store(mesh, _SIGNAL.format("smoothed_strain"), smoothed, "FLOAT_VECTOR", "FACE")


def _with_normal_change(nodes: Nodes, mesh: Any) -> Any:
    """The mesh from DEFORMED with the change of triangles' unit normals in object axes stored."""
    p0, p1, p2 = nodes.triangle_corners()
    edges = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
    normal = nodes.vector("CROSS_PRODUCT", *edges)
    rest = nodes.attribute(stored.NEUTRAL_NORMAL)
    length = nodes.vector("LENGTH", normal)
    has_area = nodes.compare("GREATER_EQUAL", length, MIN_SQUARED_NORMAL**0.5)
    unit = nodes.switch("VECTOR", has_area, (0, 0, 0), nodes.vector("NORMALIZE", normal))
    had_area = nodes.compare("GREATER_THAN", nodes.vector("LENGTH", rest), 0.5)
    change = nodes.vector("SUBTRACT", unit, rest)
    change = nodes.switch("VECTOR", had_area, (0, 0, 0), change)
    change = _in_range(nodes, change, stored.NORMAL_RANGE)
    return nodes.store(mesh, _SIGNAL.format("normal"), change, "FLOAT_VECTOR", "FACE")


def _in_range(nodes: Nodes, vector: Any, ends: tuple[str, str]) -> Any:
    lowest, highest = (nodes.attribute(name) for name in ends)
    return nodes.vector("MAXIMUM", nodes.vector("MINIMUM", vector, highest), lowest)


POSED = _meshes("Posed Triangles", _posed, "Head", "Neutral")
"""Head and neutral mesh -> the head with the faces that splats are bound to."""
FOLLOWING = _meshes("Splats of a Head", _following, "Splats", "Head", "Neutral")
"""Splats, head and neutral mesh -> the splats; none where the head has lost their vertices."""
DEFORMED = _meshes("Triangle Deformation", _deformed, "Posed", "Neutral")
"""Posed and neutral mesh -> the mesh with its triangles' deformation."""
SIGNALS = {
    "smoothed_strain": _meshes("Smoothed Strain", _with_smoothed_strain, "Deformed"),
    "normal": _meshes("Normal Change", _with_normal_change, "Deformed"),
}
"""Name, as in `avatar.offsets.SIGNALS` -> mesh from DEFORMED to the same with the signal's three
components. Offsets of any other signal are displayed as trained only."""


@cache
def driven(name: str, convention: str) -> NodeGroup:
    """The group that moves, scales or colors triangles by a driven offset, as
    `avatar.offsets.moved_frames`: a mesh from FRAMES with the signal to the same mesh."""

    def build(nodes: Nodes, mesh: Any) -> Any:
        offset = OFFSETS[name]
        signal = nodes.components(nodes.attribute(_SIGNAL.format(offset.signal)))
        names = [stored.DRIVEN_OFFSET.format(name, index) for index in range(len(signal))]
        target = FACE_COLOR
        change = _weighted(nodes, names, signal)
        if offset.target == SCALE:
            log_scale, _, _ = nodes.components(change)
            if convention == "stga":  # whose size is an area
                log_scale = nodes.math("MULTIPLY", log_scale, 2.0)
            size = nodes.attribute(_FRAME_SIZE, "FLOAT")
            size = nodes.math("MULTIPLY", size, nodes.math("EXPONENT", log_scale))
            return nodes.store(mesh, _FRAME_SIZE, size, "FLOAT", "FACE")
        if offset.target != COLOR:
            target = _FRAME_ORIGIN
            change, _, _ = _in_space(nodes, nodes.attribute, change, convention)
        # A color that is not there yet counts as 0.
        total = nodes.vector("ADD", nodes.attribute(target), change)
        return nodes.store(mesh, target, total, "FLOAT_VECTOR", "FACE")

    return _meshes(f"Driven Offset ({name}, {convention})", build, "Frames")
