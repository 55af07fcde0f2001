"""Initial splats: a regular lattice on every triangle of the neutral mesh."""

import numpy as np

from .embedding import face_areas, face_frames
from .splats import Splats

NORMAL_AXIS = {"stga": 2, "gaussian_avatars": 1}
"""Convention -> local axis along the triangle's normal."""
SCALE = 0.6
"""Standard deviation of a splat per spacing of the lattice."""
FLATNESS = 0.5
"""Standard deviation along the normal per that in the triangle's plane."""
INSET = 0.1
"""Fraction of the way to the centroid by which points lie inside their triangle: neighbors' points
must not coincide."""
MIN_SPACING_M = 1e-6  # the scale of splats on a triangle without area still needs a logarithm


def splats_per_triangle(order: int) -> int:
    return (order + 1) * (order + 2) // 2


def lattice_splats(
    neutral: np.ndarray,
    faces: np.ndarray,
    order: int = 2,
    sh_degree: int = 3,
    opacity_logit: float = 0.0,
    convention: str = "stga",
) -> Splats:
    """(order + 1)(order + 2) / 2 splats on every triangle, triangle by triangle, in its local
    frame.

    neutral (V, 3) meters, faces (F, 3). Order 0 puts one splat on the centroid, order 2 the corners
    of the four triangles that the edge midpoints cut, order 4 their midpoints too (STGA,
    initialization: 15 a triangle). The standard deviation is SCALE · sqrt(2 · area) / order in the
    triangle's plane (sqrt(2 · area): the leg of the right isosceles triangle of that area). Color
    starts at raw zero: gray.
    """
    weights = lattice_weights(order, INSET)
    frames = face_frames(neutral, faces, neutral, convention)
    corners = np.asarray(neutral, np.float64)[faces] - frames.origin[:, None]
    scale = np.maximum(frames.scale, MIN_SPACING_M)
    local = np.einsum("fji,fcj->fci", frames.rotation, corners) / scale[:, None, None]
    xyz = np.einsum("pc,fci->fpi", weights, local).reshape(-1, 3)

    spacing = np.sqrt(2 * face_areas(neutral, faces)) / max(order, 1)
    sigma = SCALE * np.maximum(spacing, MIN_SPACING_M) / scale
    stretch = np.ones(3)
    stretch[NORMAL_AXIS[convention]] = FLATNESS
    count = len(xyz)
    log_scale = np.log(sigma[:, None] * stretch).astype(np.float32)
    return Splats(
        xyz=xyz.astype(np.float32),
        rotation=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scale=np.repeat(log_scale, len(weights), axis=0),
        opacity=np.full(count, opacity_logit, np.float32),
        sh=np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32),
        face=np.repeat(np.arange(len(faces), dtype=np.int32), len(weights)),
        unbound=np.zeros(count, bool),
    )


def lattice_weights(order: int, inset: float) -> np.ndarray:
    """Barycentric coordinates (P, 3) of the lattice of `order`, pulled towards the centroid by
    `inset`."""
    if order == 0:
        return np.full((1, 3), 1 / 3)
    steps = [(order - j - k, j, k) for j in range(order + 1) for k in range(order + 1 - j)]
    return (1 - inset) * np.array(steps) / order + inset / 3
