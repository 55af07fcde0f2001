"""Points of the mesh that splats belong to, and its normals."""

import numpy as np

from ..avatar.embedding import face_frames
from ..avatar.file import Avatar


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals, weighted by the area of triangles; 0 where a vertex has none."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.stack([np.bincount(faces.ravel(), np.repeat(n, 3), len(vertices)) for n in normal.T], axis=-1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20))


def barycentric(avatar: Avatar) -> np.ndarray:
    """(N, 3) weights of the corners of each splat's triangle: of the point that is nearest to it in the neutral mesh,
    within the triangle up to clamping."""
    frames = face_frames(avatar.neutral, avatar.faces, avatar.neutral, avatar.convention)
    face = avatar.splats.face
    offset = frames.scale[face, None] * np.einsum("nij,nj->ni", frames.rotation[face], avatar.splats.xyz)
    a, b, c = (avatar.neutral[avatar.faces[face, k]].astype(np.float64) for k in range(3))
    point, first, second = frames.origin[face] + offset - a, b - a, c - a
    uu, uv, vv = (first * first).sum(1), (first * second).sum(1), (second * second).sum(1)
    pu, pv = (point * first).sum(1), (point * second).sum(1)
    area = np.maximum(uu * vv - uv * uv, 1e-30)
    u, v = (vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area
    weights = np.clip(np.stack([1 - u - v, u, v], axis=-1), 0, 1)
    return np.asarray(weights / weights.sum(1, keepdims=True))


def at_splats(values: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N, C) float32 of values (V, C) at points of triangles: faces (N, 3) their corners, weights (N, 3)."""
    values = np.asarray(values, np.float32)
    found = weights[:, :1] * values[faces[:, 0]]
    found += weights[:, 1:2] * values[faces[:, 1]]
    found += weights[:, 2:] * values[faces[:, 2]]
    return np.asarray(found)
