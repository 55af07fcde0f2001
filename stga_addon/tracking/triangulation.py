"""Robust triangulation of landmarks seen by calibrated cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..capture.camera import Camera

ITERATIONS = 15
OUTLIER_SCALE = 1.5
"""Distances from a ray, in medians of the landmark's, at which its weight is a quarter."""
MIN_DISTANCE_SHARE = 1e-5
"""Of outliers' scale, as a share of the distance to the cameras; below is rounding."""
RANK_GUARD = 1e-9


@dataclass(frozen=True)
class Triangulation:
    """What one timestep's cameras say of N landmarks, in the units of the cameras' world.

    position     (N, 3) the best point; for a single ray, one on that ray; without a ray, the center
                 of the cameras
    information  (N, 3, 3) weighted mean over the rays of I − d dᵀ: (x − position)ᵀ information (x −
                 position) is the mean squared distance of x from the rays, up to a constant
    residual     (N,) median distance of the rays from `position`, 0 where there is none
    seen         (N,) bool: by two cameras at least, or by the only one
    """

    position: np.ndarray
    information: np.ndarray
    residual: np.ndarray
    seen: np.ndarray


def rays(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (N, 3) in the world of pixels (N, 2)."""
    flat = (points - [camera.cx, camera.cy]) / [camera.fl_x, camera.fl_y]
    local = np.column_stack([flat, np.ones(len(points))])
    directions = local @ camera.world_to_camera[:3, :3]
    return camera.position, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def triangulate(
    cameras: Sequence[Camera], points: np.ndarray, confidence: np.ndarray
) -> Triangulation:
    """Landmarks (C, N, 2) pixels with confidence (C, N) ≥ 0, 0 for not seen, of C cameras at one
    timestep.

    Iteratively reweighted least squares with Geman-McClure weights; scale per landmark is its
    median residual.
    """
    pairs = [rays(camera, pixels) for camera, pixels in zip(cameras, points, strict=True)]
    origins, directions = map(np.stack, zip(*pairs, strict=True))
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]  # (C, N, 3, 3)
    offsets = np.einsum("cnij,cj->cni", across, origins)
    guess = origins.mean(0) + (directions * confidence[..., None]).sum(0)
    weights = confidence.astype(np.float64)
    position, distance = guess, np.zeros(confidence.shape)
    for _ in range(ITERATIONS):
        total = weights.sum(0)
        share = weights / np.where(total > 0, total, 1.0)
        information = np.einsum("cn,cnij->nij", share, across)
        right = np.einsum("cn,cni->ni", share, offsets)
        guard = RANK_GUARD * np.eye(3)  # a single ray leaves the position along it open
        position = np.linalg.solve(information + guard, (right + guess @ guard)[..., None])[..., 0]
        to_point = position[None] - origins[:, None]
        distance = np.linalg.norm(np.cross(to_point, directions), axis=2)
        scale = OUTLIER_SCALE * _median(distance, confidence > 0)
        floor = MIN_DISTANCE_SHARE * np.linalg.norm(to_point, axis=2)
        # a point without a ray may lie in a camera, at distance 0 from its ray
        usual = np.maximum(np.maximum(scale, floor), np.finfo(np.float64).tiny)
        weights = confidence / (1 + (distance / usual) ** 2) ** 2
    seen = (confidence > 0).sum(0) >= min(2, len(cameras))
    return Triangulation(position, information, _median(distance, confidence > 0), seen)


def _median(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Lower median (N,) of the valid ones of values (C, N); 0 where none is."""
    ordered = np.sort(np.where(valid, values, np.inf), axis=0)
    middle = np.maximum(valid.sum(0) - 1, 0) // 2
    return np.where(valid.any(0), np.take_along_axis(ordered, middle[None], axis=0)[0], 0.0)
