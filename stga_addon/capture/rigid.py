"""Removal of rigid head motion from a tracked mesh."""

import numpy as np

MAX_ITERATIONS = 100
MIN_RESIDUAL = 1e-7
"""Share of the mesh's size below which residuals are rounding."""


def without_head_motion(mesh: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    """The mesh (V, 3) moved rigidly onto the neutral mesh (V, 3), without scale (STGA, selective training).

    A robust Procrustes fit: vertices that the expression moves, such as those of an open jaw, get hardly any weight,
    provided that less than half of all vertices move against the skull. A plain least-squares fit would tilt the head.
    The neutral mesh must have an extent (`meshes.check_extent`).
    """
    size = np.linalg.norm(np.ptp(neutral, axis=0))
    weights = np.ones(len(mesh))
    fitted = np.asarray(mesh, np.float64)
    for _ in range(MAX_ITERATIONS):
        rotation, translation = weighted_procrustes(mesh, neutral, weights)
        before, fitted = fitted, mesh @ rotation.T + translation
        residual = np.linalg.norm(fitted - neutral, axis=1)
        # Geman-McClure weights, scaled by the median residual: they fall with its fourth power.
        scale = max(float(np.median(residual)), MIN_RESIDUAL * size)
        weights = 1 / (1 + (residual / scale) ** 2) ** 2
        if np.abs(fitted - before).max() < MIN_RESIDUAL * size:
            break
    return np.asarray(fitted)


def weighted_procrustes(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3,) with least Σ w·|R·source + t − target|² (Kabsch); points (N, 3)."""
    share = (weights / weights.sum())[:, None]
    source_center, target_center = (share * source).sum(0), (share * target).sum(0)
    u, _, vt = np.linalg.svd((target - target_center).T @ (share * (source - source_center)))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, target_center - rotation @ source_center
