"""Rigid head motion of a tracked mesh, and how to take it away."""

import numpy as np

ITERATIONS = 100
FLOOR = 1e-7  # of the mesh's size: residuals below it are rounding


def without_head_motion(mesh: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    """The mesh (V, 3) moved rigidly onto the neutral mesh (V, 3), without scale (STGA, selective training).

    A robust Procrustes fit: vertices that the expression moves, such as an open jaw, get next to no weight, as
    long as less than half of all vertices move against the skull. A plain least-squares fit would tilt the head.
    """
    size = np.linalg.norm(np.ptp(neutral, axis=0))
    weights = np.ones(len(mesh))
    fitted = np.asarray(mesh, np.float64)
    for _ in range(ITERATIONS):
        rotation, translation = weighted_procrustes(mesh, neutral, weights)
        before, fitted = fitted, mesh @ rotation.T + translation
        residual = np.linalg.norm(fitted - neutral, axis=1)
        # Geman-McClure weights at the scale of the typical vertex: far ones vanish with the fourth power.
        scale = max(float(np.median(residual)), FLOOR * size)
        weights = 1 / (1 + (residual / scale) ** 2) ** 2
        if np.abs(fitted - before).max() < FLOOR * size:
            break
    return np.asarray(fitted)


def weighted_procrustes(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3,) with least Σ w·|R·source + t − target|² (Kabsch); points (N, 3)."""
    share = (weights / weights.sum())[:, None]
    source_centre, target_centre = (share * source).sum(0), (share * target).sum(0)
    u, _, vt = np.linalg.svd((target - target_centre).T @ (share * (source - source_centre)))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, target_centre - rotation @ source_centre
