"""Light that a head reflects onto itself: what a vertex does not see of the sky shows skin that is lit as around it."""

import numpy as np

from ..avatar.embedding import face_areas

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
