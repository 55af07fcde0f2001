"""Lens distortion: from the image of an ideal pinhole to the recorded one."""

from dataclasses import dataclass

import numpy as np

MIN_RADIUS = 1e-9
"""Below it, an angle and its tangent are the same number; and parameters have no effect."""


@dataclass(frozen=True)
class Lens:
    """Distortion of normalized image points, applied in this order.

    projection  how the angle θ off the axis becomes a radius: "perspective" (tan θ), "fisheye" (θ),
                "field of view" (2 tan θ tan ω/2 → its arc tangent / ω) or "division" (r with r / (1
                + k r²) = tan θ)
    parameter   ω (radians) of "field of view", k of "division"
    radial      k1, k2, … of 1 + k1 r² + k2 r⁴ + …, any number
    rational    the same for the denominator (k4 to k6 of OpenCV's rational model)
    tangential  p1, p2 as OpenCV counts them: x += 2 p1 x y + p2 (r² + 2 x²), y += p1 (r² + 2 y²) +
                2 p2 x y
    prism       s1 to s4: x += s1 r² + s2 r⁴, y += s3 r² + s4 r⁴
    affine      b1, b2 as shares of the focal length: x += b1 x + b2 y
    """

    projection: str = "perspective"
    radial: tuple[float, ...] = ()
    rational: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    affine: tuple[float, float] = (0.0, 0.0)
    parameter: float = 0.0

    @property
    def is_ideal(self) -> bool:
        """Whether nothing is distorted."""
        return self.projection == "perspective" and not any(
            (*self.radial, *self.rational, *self.tangential, *self.prism, *self.affine)
        )

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Recorded points (…, 2) of ideal ones: both (x, y) / depth, x right, y down, not yet in
        pixels."""
        x, y = np.moveaxis(self._projected(np.asarray(points, np.float64)), -1, 0)
        square = x * x + y * y
        factor = _polynomial(self.radial, square) / _polynomial(self.rational, square)
        (p1, p2), (s1, s2, s3, s4), (b1, b2) = self.tangential, self.prism, self.affine
        u = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square)
        v = y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square)
        return np.stack([u + b1 * u + b2 * v, v], axis=-1)

    def _projected(self, points: np.ndarray) -> np.ndarray:
        if self.projection == "perspective":
            return points
        tangent = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), MIN_RADIUS)
        return np.asarray(points * self._radius(tangent) / tangent)

    def _radius(self, tangent: np.ndarray) -> np.ndarray:
        if self.projection == "fisheye" or abs(self.parameter) < MIN_RADIUS:
            return np.arctan(tangent) if self.projection == "fisheye" else tangent
        if self.projection == "field of view":
            return np.asarray(np.arctan(2 * tangent * np.tan(self.parameter / 2)) / self.parameter)
        with np.errstate(invalid="ignore"):  # NaN beyond the widest angle that the lens shows
            return np.asarray(2 * tangent / (1 + np.sqrt(1 - 4 * self.parameter * tangent**2)))


def _polynomial(coefficients: tuple[float, ...], square: np.ndarray) -> np.ndarray:
    """1 + k1 r² + k2 r⁴ + … at r² = `square`."""
    total = np.zeros_like(square)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * square
    return total + 1
