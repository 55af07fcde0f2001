"""Node groups that compute triangles' frames and strain on the head, and place splats by them."""

from collections.abc import Callable, Iterable
from functools import cache, partial, reduce
from typing import Any, NamedTuple

import bpy

from ...avatar.embedding import CONVENTIONS, MIN_AREA_RATIO, UPRIGHT_COSINE
from ...avatar.strain import AVERAGING_ROUNDS, STRAIN_COMPONENTS, STRAIN_GAIN
from . import splat_attributes as stored
from .node_builder import NodeGroup, Nodes

# Temporary attributes on the head's faces.
_FRAME_ORIGIN, _FRAME_ROTATION = "stga_frame_origin", "stga_frame_rotation"
_FRAME_SIZE = "stga_frame_size"


def _stored_frames(convention: str, nodes: Nodes, mesh: Any) -> Any:
    """The mesh with each triangle's frame stored on its faces."""
    # Sampling a stored attribute is fast; sampling a field would evaluate it once per splat.
    p0, p1, p2 = nodes.triangle_corners()
    origin = nodes.scale(nodes.sum(p0, p1, p2), 1 / 3)
    edge, side = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
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
    scale, turn = frame(_FRAME_SIZE, "FLOAT"), frame(_FRAME_ROTATION, "QUATERNION")
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
) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket, bpy.types.NodeSocket]:
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
PLACED[None] = _meshes("Place Splats (world)", partial(_placed_splats, None), "Splats")
"""Splats (and the mesh with frames) -> splats in object space; None: in world space."""


SMOOTHED_STRAIN = "stga_smoothed_strain"  # vector on the faces of the mesh from SMOOTHED
# Temporary attributes on the faces of the deformed neutral mesh.
_GRAM_CHANGE, _STRAIN = "stga_gram_change", "stga_strain"


def _deformed(nodes: Nodes, posed: Any, neutral: Any) -> Any:
    """The neutral mesh at the posed vertices, with deformation tensors (`avatar.strain`)."""
    position, index = nodes.out("GeometryNodeInputPosition"), nodes.out("GeometryNodeInputIndex")
    moved = nodes.sample(posed, position, index, "FLOAT_VECTOR", "POINT")
    mesh = nodes.out("GeometryNodeSetPosition", {"Geometry": neutral, "Position": moved})
    p0, p1, p2 = nodes.triangle_corners()
    e1, e2 = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
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


def _strained(nodes: Nodes, mesh: Any) -> Any:
    """The mesh from `_deformed` with triangles' strain (`avatar.strain.face_strain`) stored."""
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
    strain = _in_range(nodes, nodes.combine(*strains))
    return nodes.store(mesh, _STRAIN, strain, "FLOAT_VECTOR", "FACE")


def _sampled_strain(nodes: Nodes, mesh: Any) -> Any:
    """Strain of each splat's triangle as a vector; mesh: from `_strained`."""
    strain, face = nodes.attribute(_STRAIN), nodes.attribute(stored.FACE, "INT")
    return nodes.sample(mesh, strain, face, "FLOAT_VECTOR")


def _with_smoothed_strain(nodes: Nodes, mesh: Any) -> Any:
    """The mesh with `avatar.strain.smoothed_strain` stored; mesh: from `_strained`."""
    strain, rest = nodes.attribute(_STRAIN), _in_range(nodes, (0, 0, 0))
    change = nodes.vector("SUBTRACT", strain, rest)
    # On faces, an iteration is the mean of a face and, by weight 1, those that share an edge.
    inputs = {"Value": change, "Iterations": AVERAGING_ROUNDS, "Weight": 1.0}
    smoothed = nodes.out("GeometryNodeBlurAttribute", inputs, data_type="FLOAT_VECTOR")
    return nodes.store(mesh, SMOOTHED_STRAIN, smoothed, "FLOAT_VECTOR", "FACE")


def _in_range(nodes: Nodes, strain: Any) -> Any:
    lowest, highest = (nodes.attribute(name) for name in stored.RANGE)
    return nodes.vector("MAXIMUM", nodes.vector("MINIMUM", strain, highest), lowest)


DEFORMED = _meshes("Triangle Deformation", _deformed, "Posed", "Neutral")
STRAIN = _meshes("Triangle Strain", _strained, "Deformed")
SAMPLED_STRAIN = NodeGroup("STGA Sampled Strain", {"Strain": "Geometry"}, "Vector", _sampled_strain)
SMOOTHED = _meshes("Smoothed Strain", _with_smoothed_strain, "Strain")


class SignalNodes(NamedTuple):
    """Nodes of a driven offset's signal, of three components at most: short label in names of
    trees, group from the mesh of STRAIN to the same with the signal stored on faces, and the
    attribute."""

    label: str
    group: NodeGroup
    attribute: str


SIGNALS = {"strain_position": SignalNodes("position", SMOOTHED, SMOOTHED_STRAIN)}
"""Driven offset -> its signal; those without are displayed as trained only."""


@cache
def shifted(offset: str, convention: str) -> NodeGroup:
    """The group that moves frames by an offset: a mesh from STRAIN with FRAMES to the same mesh."""

    def build(nodes: Nodes, mesh: Any) -> Any:
        mesh = nodes.group(SIGNALS[offset].group, mesh)
        signal = nodes.components(nodes.attribute(SIGNALS[offset].attribute))
        names = [stored.DRIVEN_OFFSET.format(offset, index) for index in range(len(signal))]
        # In the frames' own axes and unit (`avatar.offsets.moved_frames`).
        local = _weighted(nodes, names, signal)
        moved, _, _ = _in_space(nodes, nodes.attribute, local, convention)
        origin = nodes.vector("ADD", nodes.attribute(_FRAME_ORIGIN), moved)
        return nodes.store(mesh, _FRAME_ORIGIN, origin, "FLOAT_VECTOR", "FACE")

    return _meshes(f"Driven Offset ({SIGNALS[offset].label}, {convention})", build, "Frames")
