"""How distant light reaches each vertex of a head past the head itself, and what it reflects onto itself."""

import numpy as np

from ..avatar.embedding import face_areas
from ..capture.mesh_geometry import vertex_normals
from .harmonics import basis, even_directions
from .lamps import ShadowMap
from .values import Light

DIRECTIONS = 192
MAP_SIZE, BIAS_M, LIFT_M = 256, 0.0015, 0.002
"""As in `lamps`, for maps of half the size."""


def transfer_of(vertices: np.ndarray, faces: np.ndarray, directions: int = DIRECTIONS) -> tuple[np.ndarray, np.ndarray]:
    """Transfer (V, 9) float32 and occlusion (V,) float32 of a mesh (V, 3) meters, see `avatar.light.AvatarLight`.

    Σ over even directions d of visible(d) · max(0, n·d) · basis(d) · 4π / directions (Sloan, Kautz and Snyder 2002);
    a direction's visibility at all vertices is one depth map.
    """
    vertices = np.asarray(vertices, np.float64)
    normals = vertex_normals(vertices, faces)
    points, sky = vertices + LIFT_M * normals, even_directions(directions)
    harmonics = basis(sky) * (4 * np.pi / directions)
    transfer, open_sky, whole_sky = np.zeros((len(vertices), harmonics.shape[1])), *np.zeros((2, len(vertices)))
    for direction, harmonic in zip(sky, harmonics, strict=True):
        cosine = np.maximum(normals @ direction, 0)
        depths = ShadowMap(vertices, faces, Light("sun", np.ones(3), direction=-direction), size=MAP_SIZE)
        reached = cosine * depths.lit(points, BIAS_M, step=0)
        transfer += reached[:, None] * harmonic
        open_sky += reached
        whole_sky += cosine
    return transfer.astype(np.float32), (open_sky / np.maximum(whole_sky, 1e-9)).astype(np.float32)


CELL_M = 0.02
"""Side of the cells in which irradiance is averaged; a vertex sees the mean of its own and the 26 around it."""
SKIN = np.array([0.5, 0.33, 0.25])
"""Albedo of the skin that light is reflected by."""
MIN_OPEN = 0.3
"""Share of the sky that a vertex must see to count as lit skin: those inside the head do not."""


class Bounce:
    """For a neutral mesh (V, 3) meters with its ambient occlusion (V,)."""

    def __init__(self, neutral: np.ndarray, faces: np.ndarray, occlusion: np.ndarray) -> None:
        place = np.floor((neutral - neutral.min(0)) / CELL_M).astype(np.int64) + 1
        self._shape = tuple(int(n) + 2 for n in place.max(0))
        self._cell = np.ravel_multi_index(tuple(place.T), self._shape)
        area = np.bincount(faces.ravel(), np.repeat(face_areas(neutral, faces), 3), len(neutral))
        self._weight = np.where(occlusion > MIN_OPEN, area, 0)
        self._blocked = (1 - np.asarray(occlusion, np.float64))[:, None] * SKIN
        self._sum_of_weights = self._around(self._weight)

    def light(self, irradiance: np.ndarray) -> np.ndarray:
        """(V, 3) irradiance that a vertex gets from skin around it, of what arrives at vertices (V, 3)."""
        near = np.stack([self._around(self._weight * channel) for channel in np.asarray(irradiance).T], axis=-1)
        return np.asarray(self._blocked * near / np.maximum(self._sum_of_weights, 1e-12)[:, None])

    def _around(self, values: np.ndarray) -> np.ndarray:
        """(V,): sum of values (V,) in each vertex's cell and those around it."""
        total = np.bincount(self._cell, values, int(np.prod(self._shape))).reshape(self._shape)
        for axis in range(3):
            ahead, behind = np.roll(total, 1, axis), np.roll(total, -1, axis)  # the outermost cells are empty
            total = total + ahead + behind
        return np.asarray(total.ravel()[self._cell])
