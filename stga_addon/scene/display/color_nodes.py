"""Node groups for splat colors: constant, by view direction (spherical harmonics), and by the
strain of triangles."""

from math import pi, sqrt
from typing import Any

from ...avatar.splats import SH_C0
from .node_builder import NodeGroup, Nodes
from .splat_attributes import SH, STRAIN_COLOR


def constant_color(nodes: Nodes, strain: Any) -> Any:
    """The part of each splat's sRGB color, not clamped, that does not depend on the view direction.

    strain: vector from SAMPLED_STRAIN, None where colors do not follow it. Coefficients as in
    `Splats`.
    """
    terms = [nodes.scale(_sh(nodes, 0), SH_C0), (0.5, 0.5, 0.5)]
    if strain is not None:
        terms += [
            nodes.scale(nodes.attribute(STRAIN_COLOR.format(index), "FLOAT_VECTOR"), factor)
            for index, factor in enumerate(nodes.components(strain))
        ]
    return nodes.sum(*terms)


def view_color(nodes: Nodes, color: Any, degree: int, direction: Any) -> Any:
    """The constant color plus spherical harmonics of degrees 1 to `degree` in a unit direction."""
    return nodes.sum(color, *(nodes.group(band, direction) for band in SH_BANDS[:degree]))


def view_direction(nodes: Nodes, position: Any) -> tuple[Any, Any]:
    """Unit vectors from the scene's active camera to each splat, in the space the splats were
    trained in.

    Returns the direction and whether there is a camera.
    """
    camera = nodes.object_info(nodes.out("GeometryNodeInputActiveCamera")).outputs["Location"]
    direction = nodes.vector("NORMALIZE", nodes.vector("SUBTRACT", position, camera))
    # Without a camera object the location is zero, which is inside the head: no camera is there.
    return direction, nodes.compare("GREATER_THAN", nodes.vector("LENGTH", camera), 0.0)


def _srgb_to_linear(nodes: Nodes, srgb: Any) -> Any:
    """Scene-linear color of sRGB, clamped to 0…1 (IEC 61966-2-1)."""
    clamped = nodes.vector("MINIMUM", nodes.vector("MAXIMUM", srgb, (0, 0, 0)), (1, 1, 1))
    linear = []
    for value in nodes.components(clamped):
        power = nodes.math(
            "POWER", nodes.math("DIVIDE", nodes.math("ADD", value, 0.055), 1.055), 2.4
        )
        line = nodes.math("DIVIDE", value, 12.92)
        linear.append(
            nodes.switch("FLOAT", nodes.compare("GREATER_THAN", value, 0.04045), line, power)
        )
    return nodes.combine(*linear)


def _linear_to_srgb(nodes: Nodes, color: Any) -> Any:
    """The inverse, of colors from 0 on."""
    srgb = []
    for value in nodes.components(color):
        power = nodes.math("MULTIPLY_ADD", nodes.math("POWER", value, 1 / 2.4), 1.055, -0.055)
        line = nodes.math("MULTIPLY", value, 12.92)
        srgb.append(
            nodes.switch("FLOAT", nodes.compare("GREATER_THAN", value, 0.0031308), line, power)
        )
    return nodes.combine(*srgb)


def _sh(nodes: Nodes, index: int) -> Any:
    return nodes.attribute(SH.format(index), "FLOAT_VECTOR")


def _band(nodes: Nodes, start: int, factors: list[Any]) -> Any:
    """Sum of the coefficients from `start` on, each with its factor."""
    total = nodes.scale(_sh(nodes, start), factors[0])
    for index, factor in enumerate(factors[1:], start + 1):
        total = nodes.vector("MULTIPLY_ADD", _sh(nodes, index), factor, total)
    return total


def _times(nodes: Nodes, factor: float, *values: Any) -> Any:
    product = values[0]
    for value in values[1:]:
        product = nodes.math("MULTIPLY", product, value)
    return nodes.math("MULTIPLY", product, factor)


# Real spherical harmonics of a unit direction, one band each, with the signs of 3D Gaussian
# Splatting.


def _first_band(nodes: Nodes, direction: Any) -> Any:
    x, y, z = nodes.components(direction)
    first = sqrt(3 / (4 * pi))
    return _band(
        nodes, 1, [_times(nodes, -first, y), _times(nodes, first, z), _times(nodes, -first, x)]
    )


def _second_band(nodes: Nodes, direction: Any) -> Any:
    x, y, z = nodes.components(direction)
    xx, yy, zz = (nodes.math("MULTIPLY", v, v) for v in (x, y, z))
    mixed = sqrt(15 / (4 * pi))
    factors = [_times(nodes, mixed, x, y), _times(nodes, -mixed, y, z)]
    factors += [_times(nodes, sqrt(5 / (16 * pi)), nodes.math("MULTIPLY_ADD", zz, 3.0, -1.0))]
    factors += [
        _times(nodes, -mixed, x, z),
        _times(nodes, mixed / 2, nodes.math("SUBTRACT", xx, yy)),
    ]
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


SRGB_TO_LINEAR = NodeGroup("STGA sRGB to Linear", {"sRGB": "Vector"}, "Color", _srgb_to_linear)
LINEAR_TO_SRGB = NodeGroup("STGA Linear to sRGB", {"Color": "Color"}, "Vector", _linear_to_srgb)
SH_BANDS = tuple(
    NodeGroup(f"STGA Spherical Harmonics {degree}", {"Direction": "Vector"}, "Vector", build)
    for degree, build in enumerate((_first_band, _second_band, _third_band), 1)
)
