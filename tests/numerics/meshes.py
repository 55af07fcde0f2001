"""Meshes for numerical tests: degenerate triangles, and a bent ball."""

import numpy as np
import trimesh

WHOLE = np.array([[0.0, 0, 0], [0.009, 0.001, 0.002], [0.002, 0.008, -0.001]])
"""A sound triangle, for the frames in which the others are sound."""


def _line(direction, places):
    """Corners on a line through a point that float32 cannot hold exactly."""
    unit = np.array(direction) / np.linalg.norm(direction)
    return np.array([0.0371, -0.0213, 0.0555]) + np.array(places)[:, None] * 0.01 * unit


DEGENERATE = {
    "point": np.tile([[0.0371, -0.0213, 0.0555]], (3, 1)),
    "line": _line([0.3, -0.5, 0.81], [0, 0.35, 1]),
    "line along x": _line([1, 0, 0], [0, 0.35, 1]),
    "upright line": _line([0.1, 0.2, 0.97], [0, 0.35, 1]),
    "line, first corner in the middle": _line([0.3, -0.5, 0.81], [0.5, 0, 1]),
    "line, first corner last": _line([-0.7, 0.5, 0.4], [1, 0, 0.3]),
    "first two corners one": _line([0.3, -0.5, 0.81], [0, 0, 1]),
    "last two corners one": _line([-0.7, 0.5, 0.4], [0, 1, 1]),
    "first and last corner one": _line([0.2, 0.9, 0.4], [0, 1, 0]),
    "needle, 1e6 : 1": _line([0.3, -0.5, 0.81], [0, 0.5, 1]) + np.eye(3)[1, :, None] * [1e-8, 0, 0],
}
"""Degenerate triangles by name, as corners (3, 3) at the scale of a head's, in meters."""


def mesh_of(triangles):
    """Vertices (3·F, 3), as a float32 file would hold them, and faces (F, 3) int32 of separate
    triangles."""
    vertices = np.concatenate(triangles).astype(np.float32).astype(np.float64)
    return vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)


def bent_ball():
    """Posed and neutral vertices (V, 3) of a ball, and its faces."""
    sphere = trimesh.creation.icosphere(2, 0.1)
    neutral = np.array(sphere.vertices)
    noise = np.random.default_rng(6).normal(size=neutral.shape) * 0.003
    return neutral * [1.1, 0.9, 1] + noise, neutral, np.array(sphere.faces, np.int32)


def collapsed():
    """Triangles that become lines and points."""
    posed, faces = mesh_of([*DEGENERATE.values()])
    return posed, mesh_of([WHOLE] * len(DEGENERATE))[0], faces
