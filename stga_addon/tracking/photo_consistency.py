"""Where a surface lies along its normals, from image patches that agree (multi-view stereo)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import rasterize

PATCH_SAMPLES = 9  # Samples along each side of a patch
MAX_CAMERAS = 6  # Cameras that a patch is compared in: those that see it most squarely
MIN_COSINE = 0.35
"""Of the angle between normal and camera: beyond 70°, a patch is too foreshortened."""
MIN_CORRELATION = 0.5
NOISE_LEVELS = 2.0
"""Standard deviation of image noise, of 255: patches of less contrast do not correlate."""
OCCLUSION_M = 0.004  # A point this far behind the nearest surface is hidden
DEPTH_IMAGE_SIDE = 300
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True)
class Sweep:
    """Offsets in meters, −reach to +reach, a step apart; a patch's samples are `spacing` apart."""

    reach: float
    step: float
    spacing: float

    @property
    def offsets(self) -> np.ndarray:
        count = round(self.reach / self.step)
        return self.step * np.arange(-count, count + 1)


@dataclass(frozen=True)
class GrayView:
    """A calibrated gray image (H, W) float32, levels from 0 to 255."""

    camera: Camera
    image: np.ndarray


def gray_view(camera: Camera, image: np.ndarray, center: np.ndarray, spacing: float) -> GrayView:
    """The image (H, W, 3) uint8, reduced as far as its pixels at `center` (3,) stay smaller than
    `spacing` meters."""
    pixel = float(camera.project(center[None])[1][0]) / camera.fl_x
    factor = int(np.clip(spacing / max(pixel, 1e-9), 1, min(image.shape[:2])))
    gray = image.astype(np.float32) @ LUMA
    height, width = (side // factor * factor for side in gray.shape)
    blocks = gray[:height, :width].reshape(height // factor, factor, width // factor, factor)
    focal, principal = (camera.fl_x / factor, camera.fl_y / factor), camera.cx / factor
    size, pose = (width // factor, height // factor), camera.world_to_camera
    scaled = Camera(*size, *focal, principal, camera.cy / factor, pose)
    return GrayView(scaled, blocks.mean((1, 3)))


def facing(camera: Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Cosine (N,) of the angle between unit normals (N, 3) and the direction to the camera."""
    towards = camera.position - points
    return np.asarray((towards * normals).sum(1) / np.linalg.norm(towards, axis=1))


def in_sight(
    camera: Camera, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """(N,) bool: points (N, 3) that the mesh does not hide, by a depth image of reduced size."""
    small = camera.scaled(min(1.0, DEPTH_IMAGE_SIDE / max(camera.width, camera.height)))
    triangle, inside = rasterize(vertices, faces, small)
    covered = triangle >= 0
    closeness, corners = np.zeros(triangle.shape), faces[triangle[covered]]
    closeness[covered] = (inside[covered] / small.project(vertices)[1][corners]).sum(1)
    flat, depth = small.project(points)
    x, y = np.clip(np.nan_to_num(flat), -1, [small.width, small.height]).astype(np.int64).T
    within = (flat >= 0).all(1) & (x < small.width) & (y < small.height) & (depth > 0)
    seen = np.zeros(len(points), bool)
    seen[within] = closeness[y[within], x[within]] * (depth[within] - OCCLUSION_M) < 1
    return seen


def surface_offsets(
    views: Sequence[GrayView],
    cosines: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    sweep: Sweep,
) -> tuple[np.ndarray, np.ndarray]:
    """Offset (N,) in meters along the normals at which the images agree best, and their correlation
    (N,) there.

    points, normals (N, 3); cosines (C, N) as `facing` gives them, 0 for what a camera does not see.
    The correlation is 0 where fewer than two cameras see a point, where they agree too little, and
    where no offset is a maximum.
    """
    usable = np.where(cosines > MIN_COSINE, cosines, 0.0)
    worst = np.zeros(len(points))
    if len(views) > MAX_CAMERAS:
        worst = -np.sort(-usable, axis=0)[: MAX_CAMERAS + 1][-1]
    usable = np.where(usable > worst, usable, 0.0)
    patches, window = _patches(points, normals, sweep.spacing)
    offsets = sweep.offsets.astype(np.float32)
    total = np.zeros((len(points), len(offsets), len(window)), np.float32)
    own = np.zeros(total.shape[:2], np.float32)  # what patches add by agreeing with themselves
    for view, cosine in zip(views, usable, strict=True):
        rows = np.flatnonzero(cosine)
        if len(rows):
            weight = cosine[rows, None].astype(np.float32)
            patch = _sampled(view, patches[rows], normals[rows], offsets)
            patch = (patch - (patch @ window)[..., None]) * np.sqrt(window)
            patch = patch / np.sqrt((patch**2).sum(-1, keepdims=True) + NOISE_LEVELS**2)
            total[rows] += weight[..., None] * patch
            own[rows] += weight**2 * (patch**2).sum(2)
    pairs = np.maximum(usable.sum(0) ** 2 - (usable**2).sum(0), 1e-6)
    # the mean of all pairs of patches, weighted by the cosines of both cameras
    correlation, rows = ((total**2).sum(2) - own) / pairs[:, None], np.arange(len(points))
    best = correlation.argmax(1)
    middle = np.clip(best, 1, len(offsets) - 2)
    before, at, after = (correlation[rows, middle + shift] for shift in (-1, 0, 1))
    bend = np.maximum(2 * at - before - after, 1e-6)
    peak = np.clip((after - before) / (2 * bend), -0.5, 0.5)
    vertex = sweep.offsets[middle] + sweep.step * peak
    return vertex, np.where((best == middle) & (at > MIN_CORRELATION), at, 0.0)


def _patches(
    points: np.ndarray, normals: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sample positions (N, P, 3) in the tangent planes; weights (P,), largest at the center."""
    axis = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(axis, normals)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    along = np.cross(normals, across)
    steps = np.arange(PATCH_SAMPLES) - (PATCH_SAMPLES - 1) / 2
    u, v = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    weight = np.exp(-(u**2 + v**2) / (2 * (0.3 * PATCH_SAMPLES) ** 2))
    away = u[:, None] * across[:, None] + v[:, None] * along[:, None]
    return points[:, None] + spacing * away, (weight / weight.sum()).astype(np.float32)


def _sampled(
    view: GrayView, patches: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Levels (M, D, P) of patches (M, P, 3) moved along their normals by offsets (D,)."""
    import cv2

    camera, turn = view.camera, view.camera.world_to_camera[:3, :3]
    local = (patches @ turn.T + camera.world_to_camera[:3, 3]).astype(np.float32)
    moved = offsets[None, :, None] * (normals @ turn.T).astype(np.float32)[:, None, :]  # (M, D, 3)
    x, y, depth = (local[:, None, :, axis] + moved[..., axis : axis + 1] for axis in range(3))
    x = x / depth * np.float32(camera.fl_x) + np.float32(camera.cx - 0.5)
    y = y / depth * np.float32(camera.fl_y) + np.float32(camera.cy - 0.5)
    found = np.empty(x.shape, np.float32)
    # Coordinates apart, unlike `appearance.sampled`: to pair them takes five times as long as to
    # look them up.
    for row in range(len(x)):
        cv2.remap(view.image, x[row], y[row], cv2.INTER_LINEAR, found[row], cv2.BORDER_REPLICATE)
    return found
