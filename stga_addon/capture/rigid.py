"""Rotations, shifts and scales that lay one set of points onto another; removal of rigid head motion from a mesh."""

from dataclasses import dataclass, replace

import numpy as np

from .camera import Camera

MAX_ITERATIONS = 100
MIN_RESIDUAL = 1e-7
"""Share of the mesh's size below which residuals are rounding."""


@dataclass(frozen=True)
class Similarity:
    """x ↦ scale · rotation x + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def camera(self, camera: Camera) -> Camera:
        """The camera in the world that `apply` leads to."""
        pose = np.eye(4)
        pose[:3, :3] = camera.world_to_camera[:3, :3] @ self.rotation.T
        pose[:3, 3] = self.scale * camera.world_to_camera[:3, 3] - pose[:3, :3] @ self.translation
        return replace(camera, world_to_camera=pose)


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


def similarity(source: np.ndarray, target: np.ndarray, metric: bool = False) -> Similarity:
    """The similarity with the least Σ |apply(source) − target|² over points (N, 3) that do not coincide (Umeyama).

    metric: of those with a scale of 1.
    """
    rotation, _ = weighted_procrustes(source, target, np.ones(len(source)))
    a, b = source - source.mean(0), target - target.mean(0)
    scale = 1.0 if metric else float((b * (a @ rotation.T)).sum() / (a**2).sum())
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))
