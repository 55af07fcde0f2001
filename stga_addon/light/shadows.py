"""Shadow maps: what a light sees of a head and of other objects."""

from collections.abc import Callable, Sequence

import numpy as np

from .kernels import shadow_kernels
from .values import Caster, Light

MAP_SIZE = 512
"""Texels a side of a light's shadow map, which just holds the head."""
BIAS_M, LIFT_M = 0.004, 0.002
"""A surface shades what lies deeper by BIAS_M; points are lifted off the surface by LIFT_M along its normal, so that it
does not shade itself."""
TAP_STEP = 2.0
"""Texels between the 3 × 3 places that are looked up, for a soft edge about as wide as a splat."""
Projection = Callable[[np.ndarray], np.ndarray]
"""Points (N, 3) in meters -> (N, 3) float32: x and y in texels, depth in meters; NaN where a light cannot see them."""


def light_projection(vertices: np.ndarray, light: Light, size: int = MAP_SIZE) -> Projection:
    """How a light sees space: parallel for a sun, else in perspective from its position, around the head.

    A light inside the sphere around the head sees it under a wide angle, and loses what lies behind it.
    """
    center = (vertices.max(0) + vertices.min(0)) / 2
    radius = float(np.linalg.norm(vertices - center, axis=1).max()) * 1.01 + 4 * LIFT_M
    if light.kind == "sun":
        forward, distance, scale = light.direction, np.inf, size / 2 / radius
    else:
        forward = center - light.position
        distance = float(np.linalg.norm(forward))
        forward = forward / max(distance, 1e-9)
        slope = radius / np.sqrt(max(distance**2 - radius**2, (0.3 * radius) ** 2))
        scale = size / 2 / slope
    across = np.cross(forward, (0.0, 1.0, 0.0) if abs(forward[1]) < 0.9 else (1.0, 0.0, 0.0))
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(forward, across), forward], axis=-1)
    origin = center if light.kind == "sun" else light.position

    def project(points: np.ndarray) -> np.ndarray:
        local = (points - origin) @ axes
        if light.kind != "sun":
            depth = local[:, 2:]
            local[:, :2] /= np.where(depth > 1e-4, depth, np.nan)
        local[:, :2] = local[:, :2] * scale + size / 2
        return np.asarray(local, np.float32)

    return project


class ShadowMap:
    """A light's depth map of a posed head (V, 3) meters and of other objects."""

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        light: Light,
        casters: Sequence[Caster] = (),
        size: int = MAP_SIZE,
    ) -> None:
        add_depths = shadow_kernels().add_depths
        self._project = light_projection(vertices, light, size)
        self.depth = np.full((size, size), np.inf, np.float32)
        add_depths(self._project(vertices), np.ascontiguousarray(faces, np.int32), self.depth)
        for caster in casters:
            add_depths(self._project(caster.vertices), np.ascontiguousarray(caster.faces, np.int32), self.depth)

    def lit(self, points: np.ndarray, bias: float = BIAS_M, step: float = TAP_STEP) -> np.ndarray:
        """(N,) float32, 0…1: how much of the light reaches points (N, 3), which are lifted off the surface."""
        found = np.empty(len(points), np.float32)
        places = np.nan_to_num(self._project(points), nan=-1e6)  # beside the map, and so lit
        shadow_kernels().lit_shares(self.depth, places, np.float32(bias), np.float32(step), found)
        return found
