"""A splat's colour as nodes: constant, by the direction it is seen from, and by how its triangle deforms."""

from math import pi, sqrt
from typing import Any

import numpy as np

from ...avatar.splats import SH_C0
from ...avatar.strain import GAIN, LIMIT, STRAINS, StrainBasis
from .node_builder import Nodes, Part

# Attributes of the splat object that are read here.
FACE = "stga_face"
SH = "stga_sh_{}"
STRAIN_COLOR = "stga_strain_color_{}"

# Attributes of the neutral mesh (see `StrainBasis`): a symmetric tensor is two vectors, xx yy zz and xy yz zx.
_HALVES = ("stga_strain_squares", "stga_strain_products")
_GRAM, _TENSOR, _PLANE = "stga_gram", "stga_tensor_{}_{}", "stga_plane_{}_{}"
_CHANGE, _STRAIN = "stga_gram_change", "stga_strain"


def constant(nodes: Nodes, strain: Any) -> Any:
    """Display colour (sRGB, not clamped) of each splat but for what depends on where it is seen from.

    strain: vector from STRAIN, None where colours do not follow it. Coefficients as in `Splats`.
    """
    parts = [nodes.scaled(_sh(nodes, 0), SH_C0), (0.5, 0.5, 0.5)]
    if strain is not None:
        parts += [
            nodes.scaled(nodes.attribute(STRAIN_COLOR.format(index), "FLOAT_VECTOR"), factor)
            for index, factor in enumerate(nodes.components(strain))
        ]
    return nodes.plus(*parts)


def seen_from(nodes: Nodes, color: Any, degree: int, direction: Any) -> Any:
    """The constant colour, and what spherical harmonics up to `degree` add to it for a unit direction."""
    return nodes.plus(color, *(nodes.part(band, direction) for band in BANDS[:degree]))


def _scene_linear(nodes: Nodes, srgb: Any) -> Any:
    """sRGB, clamped to 0…1, as Blender stores colours: the transfer curve of IEC 61966-2-1, backwards."""
    clamped = nodes.vector("MINIMUM", nodes.vector("MAXIMUM", srgb, (0, 0, 0)), (1, 1, 1))
    linear = []
    for value in nodes.components(clamped):
        bent = nodes.math("POWER", nodes.math("DIVIDE", nodes.math("ADD", value, 0.055), 1.055), 2.4)
        low = nodes.math("DIVIDE", value, 12.92)
        linear.append(nodes.switch("FLOAT", nodes.compare("GREATER_THAN", value, 0.04045), low, bent))
    return nodes.combine(*linear)


def view_direction(nodes: Nodes, position: Any) -> tuple[Any, Any]:
    """From the scene's active camera to each splat, in the splats' own space, in which they were trained.

    Returns the direction and whether there is a camera.
    """
    camera = nodes.object(nodes.out("GeometryNodeInputActiveCamera")).outputs["Location"]
    direction = nodes.vector("NORMALIZE", nodes.vector("SUBTRACT", position, camera))
    # Without an object the location is zero, where no camera stands: inside the head.
    return direction, nodes.compare("GREATER_THAN", nodes.vector("LENGTH", camera), 0.0)


def _deformed(nodes: Nodes, posed: Any, neutral: Any) -> Any:
    """The neutral triangles where the posed ones are, each with the tensor of its deformation (`avatar.strain`)."""
    place, number = nodes.out("GeometryNodeInputPosition"), nodes.out("GeometryNodeInputIndex")
    moved = nodes.sample(posed, place, number, "FLOAT_VECTOR", "POINT")
    mesh = nodes.out("GeometryNodeSetPosition", {"Geometry": neutral, "Position": moved})
    p0, p1, p2 = (nodes.at(place, nodes.corner(index)) for index in range(3))
    e1, e2 = nodes.vector("SUBTRACT", p1, p0), nodes.vector("SUBTRACT", p2, p0)
    gram = nodes.combine(*(nodes.vector("DOT_PRODUCT", a, b) for a, b in ((e1, e1), (e1, e2), (e2, e2))))
    change = nodes.vector("SUBTRACT", gram, nodes.attribute(_GRAM, "FLOAT_VECTOR"))
    mesh = nodes.store(mesh, _CHANGE, change, "FLOAT_VECTOR", "FACE")
    changes = nodes.components(nodes.attribute(_CHANGE, "FLOAT_VECTOR"))
    for half in _HALVES:
        tensor = (nodes.attribute(_TENSOR.format(index, half), "FLOAT_VECTOR") for index in range(STRAINS))
        sum_ = nodes.plus(*(nodes.scaled(part, by) for part, by in zip(tensor, changes, strict=True)))
        mesh = nodes.store(mesh, half, sum_, "FLOAT_VECTOR", "FACE")
    return mesh


def _sampled_strain(nodes: Nodes, mesh: Any) -> Any:
    """Each splat's triangle's strain (`avatar.strain.face_strain`) as a vector; mesh: from `_deformed`."""
    # Faces to vertices and back: the mean over the triangles that touch a triangle.
    halves = [nodes.on_domain(nodes.attribute(half, "FLOAT_VECTOR"), "FLOAT_VECTOR", "POINT") for half in _HALVES]
    strains = []
    for index in range(STRAINS):
        plane = (nodes.attribute(_PLANE.format(index, half), "FLOAT_VECTOR") for half in _HALVES)
        parts = [nodes.vector("DOT_PRODUCT", mean, part) for mean, part in zip(halves, plane, strict=True)]
        strain = nodes.math("MULTIPLY", nodes.math("ADD", *parts), GAIN)
        strains.append(nodes.math("MAXIMUM", nodes.math("MINIMUM", strain, LIMIT), -LIMIT))
    mesh = nodes.store(mesh, _STRAIN, nodes.combine(*strains), "FLOAT_VECTOR", "FACE")
    return nodes.sample(mesh, nodes.attribute(_STRAIN, "FLOAT_VECTOR"), nodes.attribute(FACE, "INT"), "FLOAT_VECTOR")


def strain_attributes(basis: StrainBasis) -> dict[str, np.ndarray]:
    """What `_deformed` and `_sampled_strain` need of the neutral mesh: name -> vector (F, 3) of every triangle."""
    vectors = {_GRAM: basis.gram}
    for name, tensors in ((_TENSOR, basis.to_tensor), (_PLANE, basis.to_plane)):
        for index in range(STRAINS):
            for start, half in zip((0, 3), _HALVES, strict=True):
                vectors[name.format(index, half)] = tensors[:, index, start : start + 3]
    return vectors


def _sh(nodes: Nodes, index: int) -> Any:
    return nodes.attribute(SH.format(index), "FLOAT_VECTOR")


def _band(nodes: Nodes, start: int, factors: list[Any]) -> Any:
    """Sum of the coefficients from `start` on, each with its factor."""
    total = nodes.scaled(_sh(nodes, start), factors[0])
    for index, factor in enumerate(factors[1:], start + 1):
        total = nodes.vector("MULTIPLY_ADD", _sh(nodes, index), factor, total)
    return total


def _times(nodes: Nodes, factor: float, *values: Any) -> Any:
    product = values[0]
    for value in values[1:]:
        product = nodes.math("MULTIPLY", product, value)
    return nodes.math("MULTIPLY", product, factor)


# Real spherical harmonics of a unit direction, band by band, as 3D Gaussian Splatting has them.


def _first_band(nodes: Nodes, direction: Any) -> Any:
    x, y, z = nodes.components(direction)
    first = sqrt(3 / (4 * pi))
    return _band(nodes, 1, [_times(nodes, -first, y), _times(nodes, first, z), _times(nodes, -first, x)])


def _second_band(nodes: Nodes, direction: Any) -> Any:
    x, y, z = nodes.components(direction)
    xx, yy, zz = (nodes.math("MULTIPLY", v, v) for v in (x, y, z))
    mixed = sqrt(15 / (4 * pi))
    factors = [_times(nodes, mixed, x, y), _times(nodes, -mixed, y, z)]
    factors += [_times(nodes, sqrt(5 / (16 * pi)), nodes.math("MULTIPLY_ADD", zz, 3.0, -1.0))]
    factors += [_times(nodes, -mixed, x, z), _times(nodes, mixed / 2, nodes.math("SUBTRACT", xx, yy))]
    return _band(nodes, 4, factors)


def _third_band(nodes: Nodes, direction: Any) -> Any:
    x, y, z = nodes.components(direction)
    xx, yy, zz = (nodes.math("MULTIPLY", v, v) for v in (x, y, z))
    outer, inner = sqrt(35 / (32 * pi)), sqrt(21 / (32 * pi))
    ring = nodes.math("MULTIPLY_ADD", zz, 5.0, -1.0)
    three_x = nodes.math("SUBTRACT", nodes.math("MULTIPLY", xx, 3.0), yy)
    three_y = nodes.math("MULTIPLY_ADD", yy, -3.0, xx)
    difference = nodes.math("SUBTRACT", xx, yy)
    factors = [_times(nodes, -outer, y, three_x), _times(nodes, sqrt(105 / (4 * pi)), x, y, z)]
    factors += [_times(nodes, -inner, y, ring)]
    factors += [_times(nodes, sqrt(7 / (16 * pi)), z, nodes.math("MULTIPLY_ADD", zz, 5.0, -3.0))]
    factors += [_times(nodes, -inner, x, ring), _times(nodes, sqrt(105 / (16 * pi)), z, difference)]
    factors += [_times(nodes, -outer, x, three_y)]
    return _band(nodes, 9, factors)


SCENE_LINEAR = Part("STGA Scene Linear", {"sRGB": "Vector"}, "Color", _scene_linear)
DEFORMED = Part("STGA Deformed", {"Posed": "Geometry", "Neutral": "Geometry"}, "Geometry", _deformed)
STRAIN = Part("STGA Strain", {"Deformed": "Geometry"}, "Vector", _sampled_strain)
BANDS = tuple(
    Part(f"STGA Harmonics {degree}", {"Direction": "Vector"}, "Vector", build)
    for degree, build in enumerate((_first_band, _second_band, _third_band), 1)
)
