"""Smooth offsets of vertices along their normals, from where cameras see points of the surface."""

from typing import Any

import numpy as np

from .posed_points import SurfacePoints

OFFSET_DENSITY = 1.5e10
"""Weight of SURFACE_POINTS points over a head, in 1/m⁴: the two priors below are relative to it."""
SMOOTHING_M = 0.009  # Length over which offsets are smoothed
OFFSET_SIGMA_M = 0.03
"""Prior of an offset; it decides how fast offsets vanish where no surface is seen."""
OFFSET_ITERATIONS = 5
MAX_COTANGENT = 5.0  # Of an angle, 11°: those of needles would outweigh all others
SURFACE_SIGMA_M = 0.0005


def smooth_offsets(
    vertices: np.ndarray,
    faces: np.ndarray,
    points: SurfacePoints,
    residual: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:
    """Smooth values (V,) of the vertices that take the values `residual` (N,) meters at the points,
    robustly.

    weight (N,). Least squares with the squared Laplacian as prior; values vanish where no point is
    near.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import spsolve

    count = len(vertices)
    rows = np.repeat(np.arange(len(points)), 3)
    places = rows, faces[points.face].ravel()
    at = coo_array((points.barycentric.ravel(), places), shape=(len(points), count)).tocsr()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    share = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    area = np.bincount(faces.ravel(), np.repeat(share, 3), count)
    laplacian = _laplacian(vertices, faces, area)
    smooth = SMOOTHING_M**4 * laplacian.T @ diags_array(area) @ laplacian
    small = diags_array((SMOOTHING_M / OFFSET_SIGMA_M) ** 4 * np.maximum(area, 1e-9))
    prior = OFFSET_DENSITY * (smooth + small)
    values, trust = np.zeros(count), weight / SURFACE_SIGMA_M**2
    for _ in range(OFFSET_ITERATIONS):
        miss = (residual - at @ values) / (2 * SURFACE_SIGMA_M)
        robust = trust / (1 + miss**2) ** 2 if values.any() else trust / np.sqrt(1 + miss**2)
        matrix = (at.T @ diags_array(robust) @ at + prior).tocsc()
        values = spsolve(matrix, at.T @ (robust * residual))
    return np.asarray(values)


def _laplacian(vertices: np.ndarray, faces: np.ndarray, area: np.ndarray) -> Any:
    """Sparse (V, V), in 1/m²: the cotangent Laplacian (Pinkall and Polthier 1993), which depends on
    the surface alone, not on its triangles; 0 at the mesh's edge. area (V,) of the vertices."""
    from scipy.sparse import coo_array, diags_array

    size, corners = (len(vertices),) * 2, vertices[faces]
    ends = corners[:, [1, 2, 0]] - corners, corners[:, [2, 0, 1]] - corners
    sine = np.linalg.norm(np.cross(*ends), axis=2)
    cotangent = (ends[0] * ends[1]).sum(2) / np.maximum(sine, 1e-20)
    weight = np.clip(cotangent, -MAX_COTANGENT, MAX_COTANGENT) / 2
    across = np.stack([faces[:, [1, 2, 0]].ravel(), faces[:, [2, 0, 1]].ravel()])  # from its angle
    half = coo_array((weight.ravel(), across), shape=size).tocsr()
    around = half + half.T
    edges, count = np.unique(np.sort(across, axis=0), axis=1, return_counts=True)
    inner = ~np.isin(np.arange(len(vertices)), edges[:, count == 1])
    difference = around - diags_array(around.sum(axis=1))
    return (diags_array(inner / np.maximum(area, 1e-9)) @ difference).tocsr()
