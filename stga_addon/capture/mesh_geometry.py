"""Normals and connected parts of meshes."""

import numpy as np


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals, weighted by the area of triangles; 0 where a vertex has none."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.stack([np.bincount(faces.ravel(), np.repeat(n, 3), len(vertices)) for n in normal.T], axis=-1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20))


def connected_parts(vertices: int, faces: np.ndarray) -> np.ndarray:
    """(V,) int: the least vertex that each vertex is connected with."""
    part = np.arange(vertices)
    while True:
        least = part[faces].min(1)
        before = part.copy()
        for corner in faces.T:
            np.minimum.at(part, corner, least)
        part = part[part]
        if np.array_equal(part, before):
            return np.asarray(part)
