"""The end of a head model's neck, drawn out over the torso's surface as far as cameras see it.

FLAME ends in a ring of shoulders of a hand's width. Splats on clothes that hang on such a ring can
only move as one. Drawn over the clothes, its triangles lie where the splats are, and its vertices
can bend them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..flame.model import FlameModel, torso_faces

DEPTH_SIGMA_M, MIN_WEIGHT = 0.02, 0.5
"""Over which points' depths are averaged; sum of their weights, below which the surface is not
seen."""
DIRECTIONS_RAD = np.radians(np.arange(-80, 81, 5))
"""From the base of the neck, as seen from the front: from straight down to the person's left."""
SLOPE = 0.8
"""Of the angle around the neck: shoulders slope down."""
REACH_RAD, DIRECTION_SIGMA = np.radians(10), 1.0
"""Of a direction to both sides; smoothing of what is found in them, in steps."""
MIN_POINTS, FARTHEST_SHARE, BEYOND_M = 5, 0.98, 0.015
"""In a direction: points below which it is not seen, the share of them that the mesh reaches, and
how far beyond."""
FULL_HEIGHT = 0.5
"""Height (see `TorsoSheet`) from which vertices lie on the surface, not between it and the
model's."""


@dataclass(frozen=True)
class TorsoSheet:
    """The torso's part of a head model's mesh.

    vertices   (N,) ids
    triangles  (F,) bool of the whole mesh
    laplacian  sparse (N, N): number of a vertex's neighbors, and −1 for each
    height     (N,) from 0 where it joins the head to 1 at the mesh's end
    """

    vertices: np.ndarray
    triangles: np.ndarray
    laplacian: Any
    height: np.ndarray

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """The places of vertex ids in `vertices`."""
        return np.searchsorted(self.vertices, ids)


def torso_sheet(model: FlameModel) -> TorsoSheet | None:
    """The torso of a head model; None where it does not end in an open rim below the head."""
    from scipy.sparse import coo_array, csgraph
    from scipy.sparse.linalg import spsolve

    torso = torso_faces(model)
    vertices = np.unique(model.faces[torso])
    used, count = np.unique(_edges(model.faces), axis=0, return_counts=True)
    rim = np.intersect1d(used[count == 1], vertices)
    top = np.setdiff1d(np.intersect1d(model.faces[~torso], vertices), rim)
    if not len(rim) or not len(top):
        return None
    a, b = np.searchsorted(vertices, np.unique(_edges(model.faces[torso]), axis=0)).T
    near = coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(len(vertices),) * 2)
    if csgraph.connected_components(near)[0] > 1:
        return None
    laplacian = csgraph.laplacian(near).tocsr()
    height = np.zeros(len(vertices))
    height[np.searchsorted(vertices, rim)] = 1
    inner = np.flatnonzero(~np.isin(vertices, np.concatenate([rim, top])))
    height[inner] = spsolve(laplacian[inner][:, inner].tocsc(), -(laplacian[inner] @ height))
    return TorsoSheet(vertices, torso, laplacian, height)


def draped(sheet: TorsoSheet, at: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Where the sheet's vertices (N, 3) lie when it is drawn over the surface that points (P, 3)
    show.

    Both in the torso's axes, from the base of the neck: x to the person's left, y up, z forward.
    What lies around the neck, from its front to its sides, is unrolled as seen from the front, from
    straight down to the shoulders. Vertices where nothing is seen, as at the back, stay.
    """
    around = SLOPE * np.arctan2(at[:, 0], at[:, 2])
    farthest, seen = _farthest(points, around)
    outer = farthest[:, None] * np.stack([np.sin(around), -np.cos(around)], axis=1)
    flat = at[:, :2] + sheet.height[:, None] * (outer - at[:, :2])
    near = np.exp(-((flat[:, None] - points[:, :2]) ** 2).sum(2) / (2 * DEPTH_SIGMA_M**2))
    weight = near.sum(1)
    target = np.column_stack([flat, near @ points[:, 2] / np.maximum(weight, 1e-9)])
    share = np.minimum(sheet.height / FULL_HEIGHT, 1) * seen * (weight > MIN_WEIGHT)
    return np.asarray(at + share[:, None] * (target - at))


def _farthest(points: np.ndarray, around: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far (N,) the points reach in directions (N,) around the neck, as seen from the front, and
    how surely these are seen (N,), from 0 to 1."""
    from scipy.ndimage import gaussian_filter1d

    angle, distance = np.arctan2(points[:, 0], -points[:, 1]), np.linalg.norm(points[:, :2], axis=1)
    found, seen = np.zeros(len(DIRECTIONS_RAD)), np.zeros(len(DIRECTIONS_RAD))
    for number, own in enumerate(DIRECTIONS_RAD):
        near = np.abs(angle - own) < REACH_RAD
        if near.sum() >= MIN_POINTS:
            found[number], seen[number] = np.quantile(distance[near], FARTHEST_SHARE) + BEYOND_M, 1
    sure = gaussian_filter1d(seen, DIRECTION_SIGMA, mode="constant")
    found = gaussian_filter1d(found, DIRECTION_SIGMA, mode="constant") / np.maximum(sure, 1e-6)
    inside, reach, share = (
        np.interp(around, DIRECTIONS_RAD, own, 0, 0) for own in (seen, found, sure)
    )
    return reach, np.where(inside > 0.5, share, 0.0)


def _edges(faces: np.ndarray) -> np.ndarray:
    """(3 F, 2) vertex ids, the smaller one first."""
    return np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
