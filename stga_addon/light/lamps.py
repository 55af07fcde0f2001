"""What the lights of a scene add to a posed head, with their shadows."""

from collections.abc import Sequence

import numpy as np

from .array_kernels import toward_light
from .harmonics import COUNT, basis
from .kernels import shade_kernels
from .shadows import ShadowMap
from .values import Caster, Light, Lighting

FEW, SOME, MANY = 1, 2, 3
"""Points a side by which an area light is represented, by its size over its distance."""
MIN_FADE = 1e-4


class Lamps:
    """Lights around a head posed as mesh (V, 3) meters, with what blocks them."""

    def __init__(self, lighting: Lighting, mesh: np.ndarray, faces: np.ndarray, casters: Sequence[Caster] = ()) -> None:
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
        self, points: np.ndarray, normals: np.ndarray, eye: np.ndarray, roughness: np.ndarray, reflectance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance and highlight (N, 3) float32 at points (N, 3), seen from eye (3,); see `raster.cpu.shade`."""
        found = np.zeros((len(points), 3), np.float32), np.zeros((len(points), 3), np.float32)
        if not len(self._table):
            return found
        lit = np.ones((max(1, len(self._maps)), len(points)), np.float32)
        for row, shadow in zip(lit, self._maps, strict=False):
            row[:] = shadow.lit(points, normals=normals)
        shade_kernels().add_lights(
            np.ascontiguousarray(points, np.float32), np.ascontiguousarray(normals, np.float32),
            np.asarray(eye, np.float32), np.asarray(roughness, np.float32),
            np.full(len(points), reflectance, np.float32), self._table, lit, *found,
        )  # fmt: skip
        return found


def light_rows(light: Light, center: np.ndarray, shadow_map: int) -> np.ndarray:
    """(points, 16) float32: a light as rows of the table of `raster.cpu.shade`, for a head around `center` (3,)."""
    places, width = _places(light, center)
    intensity = {"sun": 1.0, "point": 1 / (4 * np.pi), "spot": 1 / (4 * np.pi), "area": 1 / np.pi}[light.kind]
    edge = np.cos(light.cone / 2)
    fade = max((1 - edge) * light.blend, MIN_FADE)
    color = light.color * intensity / len(places)
    rest = (*light.direction, *color, edge, fade, shadow_map, light.diffuse, light.specular, width)
    kind = ("sun", "point", "spot", "area").index(light.kind)
    return np.array([(kind, *place, *rest) for place in places], np.float32)


def _places(light: Light, center: np.ndarray) -> tuple[np.ndarray, float]:
    """Positions (points, 3) that stand for a light, and the width of each for `raster.cpu.shade`."""
    if light.kind == "sun":
        return light.position[None], float(np.tan(light.angle / 2))
    if light.kind != "area":
        return light.position[None], light.radius
    distance = max(float(np.linalg.norm(light.position - center)), 1e-6)
    share = max(light.size) / distance
    side = FEW if share < 0.15 else SOME if share < 0.6 else MANY
    grid = (np.arange(side) + 0.5) / side - 0.5
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    if light.shape == "ellipse":  # the square's points moved into the disk, of equal area each
        x, y = x * np.sqrt(1 - 2 * y * y), y * np.sqrt(1 - 2 * x * x)
    across = np.cross(light.direction, light.tangent)
    offset = x[:, None] * light.size[0] * light.tangent + y[:, None] * light.size[1] * across
    return light.position + offset, float(np.mean(light.size)) / 2 / side


def distant_light(light: Light, center: np.ndarray) -> np.ndarray:
    """(9, 3) harmonics of a light as if it were far away from a head around `center` (3,), without shadows."""
    found = np.zeros((COUNT, 3))
    for row in light_rows(light, center, -1):
        toward, strength, _ = toward_light(row, np.asarray(center, np.float32)[:, None])
        found += basis(toward.T).T * (strength * row[7:10] * row[13])
    return found
