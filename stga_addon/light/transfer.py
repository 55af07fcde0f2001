"""How much of distant light reaches each vertex of a head past the head itself (precomputed radiance transfer)."""

import numpy as np

from ..capture.mesh_geometry import vertex_normals
from .harmonics import basis, even_directions
from .shadows import ShadowMap
from .values import Light

DIRECTIONS = 192
MAP_SIZE, BIAS_M, LIFT_M = 256, 0.0015, 0.002
"""As in `shadows`, for maps of half the size."""


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
