"""What dense tracking minimizes at one timestep: the difference of images from the texture, and
optical flow."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..capture.camera import Camera
from .appearance import (
    CHANNEL_WEIGHTS,
    NOISE_LEVELS,
    Level,
    Sample,
    Texture,
    fitted_light,
    robust,
    sampled,
    shading,
)
from .dense_head import REGIONS, DenseHead
from .solve import prior_terms

POINT_SHARE = 0.25  # Weight of a point in a view: neighboring points share pixels
OUTLIER_SQUARED = 4.0, 4.0, 16.0, 16.0
"""By level: squared difference in NOISE_LEVELS at which a point is explained by half."""
FLOW_LEVEL, FLOW_POINTS, FLOW_ITERATIONS = 1, 2, 4
"""Pyramid level of the images of optical flow, level of the points that it moves, and Gauss–Newton
steps."""
FLOW_SHARE, FLOW_SCALE_PX = 0.3, 2.0
"""Weight of a point's flow of 1 pixel, and the distance in pixels beyond which it is an outlier."""


@dataclass(frozen=True)
class PyramidView:
    """One camera's image at a timestep: key and pose of the camera in the capture's world, and
    pyramid."""

    key: bytes
    camera: Camera
    levels: Sequence[Level]


@dataclass(frozen=True)
class Misfit:
    """How badly points are explained, from 0 to 1: over all, and by region (R,); 0 where no point
    is seen."""

    all: float
    regions: np.ndarray


def samples(
    head: DenseHead, views: Sequence[PyramidView], values: np.ndarray, weight: np.ndarray
) -> list[Sample]:
    """What the views show of the head's points; weight (C, N)."""
    at, basis = head.positions(values), head.light_basis(values)
    found = []
    for view, own in zip(views, weight, strict=True):
        projected = [level.camera.project(at) for level in view.levels]
        levels = [
            sampled([level.channels], pixels)[0].astype(np.float64)
            for level, (pixels, _) in zip(view.levels, projected, strict=True)
        ]
        found.append(
            Sample(view.key, levels, basis, own * inside(view.levels[0].camera, *projected[0]))
        )
    return found


def photo_term(
    head: DenseHead,
    views: Sequence[PyramidView],
    visible: np.ndarray,
    texture: Texture,
    values: np.ndarray,
    level: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Newton terms of the points of a level: H (M, 3, 3) and b (M, 3) by their positions."""
    at = head.level_positions(values, level)
    matrix, right = np.zeros((len(at), 3, 3)), np.zeros((len(at), 3))
    basis, rows = head.light_basis(values, level), head.rows[level]
    for view, seen in zip(views, visible, strict=True):
        own = view.levels[level]
        pixels, depth = own.camera.project(at)
        weight = seen[rows] * texture.trust[rows] * inside(own.camera, pixels, depth)
        near = np.flatnonzero(weight)
        if not len(near):
            continue
        shown, by_x, by_y = sampled([own.channels, *own.gradient], pixels[near])
        residual = _residual(view, texture, shown, basis[near], weight[near], rows[near], level)
        used = (
            POINT_SHARE
            * weight[near]
            / (1 + residual**2 @ CHANNEL_WEIGHTS / OUTLIER_SQUARED[level]) ** 2
        )
        by_x, by_y = by_x / NOISE_LEVELS, by_y / NOISE_LEVELS
        # The channels' slopes along x and y, multiplied and summed, before they become those by
        # position.
        xx, xy, yy, x, y = (
            (used * ((one * other) @ CHANNEL_WEIGHTS))[:, None]
            for one, other in (
                (by_x, by_x),
                (by_x, by_y),
                (by_y, by_y),
                (by_x, residual),
                (by_y, residual),
            )
        )
        of_x, of_y = projection_derivative(own.camera, at[near]).swapaxes(0, 1)
        along_x, along_y = xx * of_x + xy * of_y, xy * of_x + yy * of_y
        matrix[near] += of_x[:, :, None] * along_x[:, None] + of_y[:, :, None] * along_y[:, None]
        right[near] -= x * of_x + y * of_y
    return matrix, right


def misfit(
    head: DenseHead,
    views: Sequence[PyramidView],
    visible: np.ndarray,
    texture: Texture,
    values: np.ndarray,
    points: int,
    level: int,
) -> Misfit:
    """How badly a level's images are explained at the points of a level."""
    at, basis, rows = (
        head.level_positions(values, points),
        head.light_basis(values, points),
        head.rows[points],
    )
    total, weights = np.zeros(len(REGIONS)), np.zeros(len(REGIONS))
    for view, seen in zip(views, visible, strict=True):
        weight, own = seen[rows] * texture.trust[rows], view.levels[level]
        pixels, depth = own.camera.project(at)
        shown = inside(own.camera, pixels, depth)
        (found,) = sampled([own.channels], pixels)
        squared = (
            _residual(view, texture, found, basis, weight * shown, rows, level) ** 2
            @ CHANNEL_WEIGHTS
        )
        share = np.where(shown, squared / (OUTLIER_SQUARED[level] + squared), 1.0)
        total += np.bincount(head.region[rows], weight * share, len(REGIONS))
        weights += np.bincount(head.region[rows], weight, len(REGIONS))
    return Misfit(float(total.sum() / max(weights.sum(), 1e-9)), total / np.maximum(weights, 1e-9))


def _residual(
    view: PyramidView,
    texture: Texture,
    shown: np.ndarray,
    basis: np.ndarray,
    weight: np.ndarray,
    rows: np.ndarray,
    level: int,
) -> np.ndarray:
    """Channels (M, 3) that the view shows minus those of the lit texture, in NOISE_LEVELS."""
    target = texture.values[view.key][level][rows]
    light = fitted_light(shown, target, basis, weight, texture.lights[view.key])
    return np.asarray((shown - target * shading(basis, light)) / NOISE_LEVELS)


def projection_derivative(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2, 3): derivatives of the pixels of points (N, 3) by their positions."""
    turn, at = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    x, y, z = (points @ turn.T + at).T
    z = np.maximum(z, 1e-6)
    of_x = (camera.fl_x / z)[:, None] * (turn[0] - (x / z)[:, None] * turn[2])
    of_y = (camera.fl_y / z)[:, None] * (turn[1] - (y / z)[:, None] * turn[2])
    return np.stack([of_x, of_y], axis=1)


def flow_start(
    head: DenseHead,
    before: Sequence[PyramidView],
    visible: np.ndarray,
    values: np.ndarray,
    now: Sequence[PyramidView],
) -> np.ndarray:
    """Parameters at a timestep to which optical flow (DIS, Kroeger et al. 2016) carries the head of
    another one.

    before, visible (C, N), values: of the other timestep.
    """
    targets = list(flow_targets(head.level_positions(values, FLOW_POINTS), before, now))
    weights = {
        view.key: own[head.rows[FLOW_POINTS]] for view, own in zip(before, visible, strict=True)
    }
    moved = values
    for _ in range(FLOW_ITERATIONS):
        at, jacobian = head.linearized(moved, FLOW_POINTS)
        precision, right = prior_terms(head.head, moved)
        matrix = np.diag(precision)
        for key, camera, target in targets:
            miss = camera.project(at)[0] - target
            weight = np.repeat(
                FLOW_SHARE * weights[key] * robust(np.linalg.norm(miss, axis=1), FLOW_SCALE_PX), 2
            )
            flat = (projection_derivative(camera, at) @ jacobian).reshape(len(weight), -1)
            matrix, right = (
                matrix + (flat.T * weight) @ flat,
                right - flat.T @ (weight * miss.ravel()),
            )
        moved = moved + np.linalg.solve(matrix, right)
    return moved


def flow_targets(at: np.ndarray, before: Sequence[PyramidView], now: Sequence[PyramidView]) -> Any:
    """(key, camera, pixels (M, 2) that points at `at` have moved to) of each camera that saw both
    timesteps."""
    import cv2

    opencv: Any = cv2  # whose type stubs lack DIS
    flow = opencv.DISOpticalFlow_create(opencv.DISOPTICAL_FLOW_PRESET_FAST)
    first = {view.key: view.levels[FLOW_LEVEL] for view in before}
    for view in now:
        level, old = view.levels[FLOW_LEVEL], first.get(view.key)
        if (
            old is None
            or old.channels.shape != level.channels.shape
            or min(old.channels.shape[:2]) < MIN_FLOW_SIDE_PX
        ):
            continue
        pictures = [np.clip(own.channels[..., 0], 0, 255).astype(np.uint8) for own in (old, level)]
        pixels, _ = old.camera.project(at)
        yield view.key, level.camera, pixels + sampled([flow.calc(*pictures, None)], pixels)[0]


MIN_FLOW_SIDE_PX = 32  # Smaller images are too small for the patches of DIS


def inside(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """(N,) bool: pixels (N, 2) in the image, a pixel from its border, at a depth (N,) before the
    camera."""
    return np.asarray(
        (pixels > 1).all(1) & (pixels < [camera.width - 1, camera.height - 1]).all(1) & (depth > 0)
    )
