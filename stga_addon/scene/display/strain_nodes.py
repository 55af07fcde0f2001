"""Node groups that compute the strain of triangles (`avatar.strain`) on the neutral mesh, deformed as the head is."""

from typing import Any

from ...avatar.strain import AVERAGING_ROUNDS, STRAIN_COMPONENTS, STRAIN_GAIN
from .node_builder import NodeGroup, Nodes
from .splat_attributes import FACE, GRAM, PLANE, RANGE, TENSOR, TENSOR_HALVES

SMOOTHED_STRAIN = "stga_smoothed_strain"
"""Vector on the faces of the mesh from SMOOTHED."""
# Temporary attributes on the faces of the deformed neutral mesh.
_GRAM_CHANGE, _STRAIN = "stga_gram_change", "stga_strain"


def _deformed(nodes: Nodes, posed: Any, neutral: Any) -> Any:
    """The neutral mesh moved to the posed vertices, with each face's deformation tensor (`avatar.strain`) stored."""
    position, index = nodes.out("GeometryNodeInputPosition"), nodes.out("GeometryNodeInputIndex")
    moved = nodes.sample(posed, position, index, "FLOAT_VECTOR", "POINT")
    mesh = nodes.out("GeometryNodeSetPosition", {"Geometry": neutral, "Position": moved})
    p0, p1, p2 = nodes.triangle_corners()
    e1, e2 = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
    gram = nodes.combine(*(nodes.vector("DOT_PRODUCT", a, b) for a, b in ((e1, e1), (e1, e2), (e2, e2))))
    change = nodes.vector("SUBTRACT", gram, nodes.attribute(GRAM, "FLOAT_VECTOR"))
    mesh = nodes.store(mesh, _GRAM_CHANGE, change, "FLOAT_VECTOR", "FACE")
    changes = nodes.components(nodes.attribute(_GRAM_CHANGE, "FLOAT_VECTOR"))
    for half in TENSOR_HALVES:
        columns = (nodes.attribute(TENSOR.format(k, half), "FLOAT_VECTOR") for k in range(STRAIN_COMPONENTS))
        tensor = nodes.sum(*(nodes.scale(column, by) for column, by in zip(columns, changes, strict=True)))
        mesh = nodes.store(mesh, half, tensor, "FLOAT_VECTOR", "FACE")
    return mesh


def _strained(nodes: Nodes, mesh: Any) -> Any:
    """The mesh with each triangle's strain (`avatar.strain.face_strain`) stored; mesh: from `_deformed`."""
    # Faces to points and back: the mean over the triangles that touch a triangle.
    means = [nodes.on_domain(nodes.attribute(half, "FLOAT_VECTOR"), "FLOAT_VECTOR", "POINT") for half in TENSOR_HALVES]
    strains = []
    for index in range(STRAIN_COMPONENTS):
        plane = (nodes.attribute(PLANE.format(index, half), "FLOAT_VECTOR") for half in TENSOR_HALVES)
        products = [nodes.vector("DOT_PRODUCT", mean, part) for mean, part in zip(means, plane, strict=True)]
        strains.append(nodes.math("MULTIPLY", nodes.math("ADD", *products), STRAIN_GAIN))
    return nodes.store(mesh, _STRAIN, _in_range(nodes, nodes.combine(*strains)), "FLOAT_VECTOR", "FACE")


def _sampled_strain(nodes: Nodes, mesh: Any) -> Any:
    """Strain of each splat's triangle as a vector; mesh: from `_strained`."""
    return nodes.sample(mesh, nodes.attribute(_STRAIN, "FLOAT_VECTOR"), nodes.attribute(FACE, "INT"), "FLOAT_VECTOR")


def _with_smoothed_strain(nodes: Nodes, mesh: Any) -> Any:
    """The mesh with `avatar.strain.smoothed_strain` stored; mesh: from `_strained`."""
    change = nodes.vector("SUBTRACT", nodes.attribute(_STRAIN, "FLOAT_VECTOR"), _in_range(nodes, (0, 0, 0)))
    # On faces, each iteration is the mean of a face and, with weight 1, those that share an edge with it.
    inputs = {"Value": change, "Iterations": AVERAGING_ROUNDS, "Weight": 1.0}
    smoothed = nodes.out("GeometryNodeBlurAttribute", inputs, data_type="FLOAT_VECTOR")
    return nodes.store(mesh, SMOOTHED_STRAIN, smoothed, "FLOAT_VECTOR", "FACE")


def _in_range(nodes: Nodes, strain: Any) -> Any:
    lowest, highest = (nodes.attribute(name, "FLOAT_VECTOR") for name in RANGE)
    return nodes.vector("MAXIMUM", nodes.vector("MINIMUM", strain, highest), lowest)


DEFORMED = NodeGroup("STGA Triangle Deformation", {"Posed": "Geometry", "Neutral": "Geometry"}, "Geometry", _deformed)
STRAIN = NodeGroup("STGA Triangle Strain", {"Deformed": "Geometry"}, "Geometry", _strained)
SAMPLED_STRAIN = NodeGroup("STGA Sampled Strain", {"Strain": "Geometry"}, "Vector", _sampled_strain)
SMOOTHED = NodeGroup("STGA Smoothed Strain", {"Strain": "Geometry"}, "Geometry", _with_smoothed_strain)
