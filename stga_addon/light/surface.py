"""Points of the mesh that splats belong to."""

import numpy as np

from ..avatar.embedding import face_frames, points_to_world
from ..avatar.file import Avatar

MAX_STEPS = 6
"""Triangles that a splat walks over: with more, splats come nearer to the mesh by less than 1 %."""


def surface_points(avatar: Avatar) -> tuple[np.ndarray, np.ndarray]:
    """Where splats are on the neutral mesh: corners (N, 3) of a triangle, and their weights (N, 3).

    From its own triangle on, a splat walks over the edge beyond which it lies, up to MAX_STEPS times; of the triangles
    that it comes by, the one with the nearest point counts, within it up to clamping.
    """
    frames = face_frames(avatar.neutral, avatar.faces, avatar.neutral, avatar.convention)
    face = avatar.splats.face.astype(np.int64)
    points = points_to_world(avatar.splats.xyz, frames, face)
    corners, beyond = avatar.neutral[avatar.faces].astype(np.float64), _beyond_edges(avatar.faces)
    inside, weights, distance = _nearest(points, corners[face])
    found, walking, at = face.copy(), np.arange(len(face)), face
    for _ in range(MAX_STEPS):
        edge = inside.argmin(1)
        following = np.where(inside.min(1) < 0, beyond[at, edge], -1)
        goes = following >= 0
        walking, at = walking[goes], following[goes]
        inside, there, away = _nearest(points[walking], corners[at])
        nearer = away < distance[walking]
        rows = walking[nearer]
        found[rows], weights[rows], distance[rows] = at[nearer], there[nearer], away[nearer]
    return np.ascontiguousarray(avatar.faces[found]), weights.astype(np.float32)


def _beyond_edges(faces: np.ndarray) -> np.ndarray:
    """(F, 3) the triangle beyond the edge that is opposite to each corner; -1: none."""
    edges = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2).astype(np.int64), axis=1)
    key = edges[:, 0] * (int(faces.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    found = np.full(len(key), -1)
    found[order[same]], found[order[same + 1]] = order[same + 1] // 3, order[same] // 3
    return found.reshape(-1, 3)


def _nearest(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Barycentric coordinates (N, 3) of points (N, 3) in the planes of triangles (N, 3, 3), the same clamped to the
    triangle, and the square of the distance (N,) from there."""
    a, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - a
    uu, uv, vv = _dot(first, first), _dot(first, second), _dot(second, second)
    pu, pv = _dot(offset, first), _dot(offset, second)
    area = np.maximum(uu * vv - uv * uv, 1e-30)
    u, v = (vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area
    inside = np.stack([1 - u - v, u, v], axis=-1)
    weights = np.clip(inside, 0, 1)
    weights /= weights.sum(1, keepdims=True)
    away = points - np.einsum("nk,nkc->nc", weights, corners)
    return inside, weights, _dot(away, away)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("nk,nk->n", a, b))


def at_splats(values: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N, C) float32 of values (V, C) at points of triangles: faces (N, 3) their corners, weights (N, 3)."""
    values = np.ascontiguousarray(values, np.float32)
    found = np.zeros((len(faces), values.shape[1]), np.float32)
    for k in range(3):
        part = values.take(faces[:, k], axis=0)
        part *= weights[:, k, None]
        found += part
    return found
