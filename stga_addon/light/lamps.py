"""Lights of a scene at a posed head: shadow maps of what they see, and what they add."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import NamedTuple

import numpy as np

from ..raster.kernel_cache import prefers_numba
from . import array_kernels
from .array_kernels import COLOR, DIFFUSE, Surface, lit_fractions, shaded, toward_light
from .harmonics import COUNT, basis
from .values import KINDS, Caster, Light, Lighting

MAP_SIZE = 512
"""Texels a side of a light's shadow map, which just holds the head."""
LIFT_M = 0.001
"""Distance by which points are lifted off the surface, so that it does not shade itself."""
BIAS_M = 0.001
"""A surface shades what lies deeper by this, and on slopes by what its depth changes within the
taps."""
MAX_BIAS_M = 0.006
"""Largest bias on a slope."""
TAP_STEP = 1  # Texels between the 3 × 3 places that are looked up: splats soften edges already


@dataclass(frozen=True)
class LightView:
    """How a light sees a head on size² texels, parallel or in perspective from `origin` (3,). axes
    (3, 3): columns across, up, forward. scale: texels per meter, or per unit of slope. texel_m:
    about how wide a texel is on the head."""

    axes: np.ndarray
    origin: np.ndarray
    scale: float
    is_parallel: bool
    size: int
    texel_m: float

    def project(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) in meters -> (N, 3) float32: x and y in texels, depth in meters; NaN where
        a light cannot see them."""
        local = np.asarray(points, np.float32) @ self.axes.astype(np.float32)
        local -= (self.origin @ self.axes).astype(np.float32)
        factor: np.ndarray | np.float32 = np.float32(self.scale)
        if not self.is_parallel:
            depth = local[:, 2]
            factor = factor / np.where(depth > 1e-4, depth, np.float32(np.nan))
        for k in range(2):
            local[:, k] = local[:, k] * factor + np.float32(self.size / 2)
        return local


class HeadBounds(NamedTuple):
    """Middle (3,) of a posed head's box, its diagonal, and the head's radius around the middle."""

    center: np.ndarray
    diagonal: float
    radius: float


def head_bounds(vertices: np.ndarray) -> HeadBounds:
    """Those of vertices (V, 3)."""
    rows = np.ascontiguousarray(vertices.T)  # numpy is slow where the last axis is short
    low = rows.min(1)
    high = rows.max(1)
    center = (low + high) / 2
    radius = float(np.sqrt(((rows - center[:, None]) ** 2).sum(0).max()))
    return HeadBounds(center, float(np.linalg.norm(high - low)), radius)


def light_view(bounds: HeadBounds, light: Light, size: int = MAP_SIZE) -> LightView:
    """A light's view of a head: wide, and without what lies behind it, from inside the head's
    sphere."""
    center = bounds.center
    radius = bounds.radius * 1.01 + 4 * LIFT_M
    if light.kind == "sun":
        forward = light.direction
        distance = np.inf
        scale = size / 2 / radius
    else:
        forward = center - light.position
        distance = float(np.linalg.norm(forward))
        forward = forward / max(distance, 1e-9)
        slope = radius / np.sqrt(max(distance**2 - radius**2, (0.3 * radius) ** 2))
        scale = size / 2 / slope
    across = np.cross(forward, (0.0, 1.0, 0.0) if abs(forward[1]) < 0.9 else (1.0, 0.0, 0.0))
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(forward, across), forward], axis=-1)
    is_sun = light.kind == "sun"
    texel_m = bounds.diagonal / size
    return LightView(axes, center if is_sun else light.position, scale, is_sun, size, texel_m)


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
        self._view = light_view(head_bounds(vertices), light, size)
        is_parallel = self._view.is_parallel
        depth = np.full((size, size), np.inf if is_parallel else 0, np.float32)
        for mesh in (Caster(vertices, faces), *casters):
            points = self._view.project(mesh.vertices)
            # of a plane in perspective, not depth but 1 / depth is linear in texels
            if not is_parallel:
                points[:, 2] = -1 / points[:, 2]
            add_depths = depth_kernel()
            add_depths(points, np.ascontiguousarray(mesh.faces, np.int32), depth)
        if not is_parallel:
            depth = np.divide(-1, depth, np.full_like(depth, np.inf), where=depth < 0)
        self.depth = depth

    def lit(
        self,
        points: np.ndarray,
        bias: float = BIAS_M,
        step: int = TAP_STEP,
        normals: np.ndarray | None = None,
    ) -> np.ndarray:
        """Fraction of the lamp's light that reaches points: (N,) float32, 0…1.

        points: (N, 3), lifted off the surface. normals: (N, 3); on slopes they enlarge `bias`.
        """
        biases = np.full(len(points), bias, np.float32)
        if normals is not None:
            if self._view.is_parallel:
                cosine = normals @ -self._view.axes[:, 2].astype(np.float32)
            else:
                away = self._view.origin.astype(np.float32) - points
                length = np.sqrt(np.einsum("nk,nk->n", away, away))
                cosine = np.einsum("nk,nk->n", normals, away) / np.maximum(length, np.float32(1e-9))
            cosine = np.clip(cosine, 0.05, 1)
            slope = np.sqrt(1 - cosine**2) / cosine
            sloped = bias + (step + 1) * self._view.texel_m * slope
            biases = np.asarray(np.minimum(sloped, max(bias, MAX_BIAS_M)), np.float32)
        places = np.nan_to_num(self._view.project(points), nan=-1e6)  # beside the map, and so lit
        return lit_fractions(self.depth, places, biases, step)


def depth_kernel() -> Callable[[np.ndarray, np.ndarray, np.ndarray], None]:
    """`add_depths` of `raster.cpu.shadow`, ten times as fast, where Numba's kernels are compiled,
    else NumPy's."""
    kernels = import_module("...raster.cpu.shadow", __name__) if prefers_numba() else array_kernels
    return kernels.add_depths


FEW = 1
"""Points a side of an area light that is small for its distance."""
SOME = 2
"""Points a side of a larger one."""
MANY = 3
"""Points a side of the largest ones."""
MIN_FADE = 1e-4


class Lamps:
    """Lights around a head posed as mesh (V, 3) meters, with what blocks them."""

    def __init__(
        self,
        lighting: Lighting,
        mesh: np.ndarray,
        faces: np.ndarray,
        casters: Sequence[Caster] = (),
    ) -> None:
        center = (mesh.max(0) + mesh.min(0)) / 2
        self._maps: list[ShadowMap] = []
        rows = [np.zeros((0, 16), np.float32)]
        for light in lighting.lights:
            shadowed = lighting.shadows and light.casts_shadow
            if shadowed:
                self._maps.append(ShadowMap(mesh, faces, light, casters))
            rows.append(light_rows(light, center, len(self._maps) - 1 if shadowed else -1))
        self._table = np.concatenate(rows)

    def irradiance(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(N, 3) float32 at points (N, 3) with normals (N, 3)."""
        return self.shade(points, normals, np.zeros(3), np.zeros(len(points), np.float32), 0.0)[0]

    def shade(
        self,
        points: np.ndarray,
        normals: np.ndarray,
        eye: np.ndarray,
        roughness: np.ndarray,
        reflectance: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance and highlight (N, 3) at points (N, 3) seen from eye (3,)."""
        lit = np.ones((max(1, len(self._maps)), len(points)), np.float32)
        for row, shadow in zip(lit, self._maps, strict=False):
            row[:] = shadow.lit(points, normals=normals)
        surface = Surface(*(np.asarray(rows, np.float32) for rows in (points, normals, roughness)))
        return shaded(surface, np.asarray(eye, np.float32), reflectance, self._table, lit)


def light_rows(light: Light, center: np.ndarray, shadow_map: int) -> np.ndarray:
    """(points, 16) float32: a light as rows of the table of lights in `array_kernels`, for a head
    at `center` (3,)."""
    places = light.position[None]
    width = light.radius
    if light.kind == "sun":
        width = float(np.tan(light.angle / 2))
    elif light.kind == "area":
        distance = max(float(np.linalg.norm(light.position - center)), 1e-6)
        fraction = max(light.size) / distance
        side = FEW if fraction < 0.15 else SOME if fraction < 0.6 else MANY
        grid = (np.arange(side) + 0.5) / side - 0.5
        x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
        if light.shape == "ellipse":  # the square's points moved into the disk, of equal area each
            x, y = x * np.sqrt(1 - 2 * y * y), y * np.sqrt(1 - 2 * x * x)
        across = np.cross(light.direction, light.tangent)
        offset = x[:, None] * light.size[0] * light.tangent + y[:, None] * light.size[1] * across
        places = light.position + offset
        width = float(np.mean(light.size)) / 2 / side
    kind = KINDS.index(light.kind)
    intensity = (1.0, 1 / (4 * np.pi), 1 / (4 * np.pi), 1 / np.pi)[kind]
    edge = np.cos(light.cone / 2)
    fade = max((1 - edge) * light.blend, MIN_FADE)
    color = light.color * intensity / len(places)
    rest = (*light.direction, *color, edge, fade, shadow_map, light.diffuse, light.specular, width)
    return np.array([(kind, *place, *rest) for place in places], np.float32)


def distant_light(light: Light, center: np.ndarray) -> np.ndarray:
    """(9, 3) harmonics of a light as if far away from a head at `center` (3,), unshadowed."""
    found = np.zeros((COUNT, 3))
    for row in light_rows(light, center, -1):
        toward, strength, _ = toward_light(row, np.asarray(center, np.float32)[:, None])
        found += basis(toward.T).T * (strength * row[COLOR] * row[DIFFUSE])
    return found
