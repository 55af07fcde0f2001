"""Where a surface's outline lies in the masks of calibrated cameras."""

import math

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import rasterize
from .photo_consistency import facing

MAX_COSINE = 0.25
"""Of the angle between normal and camera: points within 15° of the outline move it."""
RIM_COSINE = 0.5
"""The same of a triangle: those farther from the outline are not drawn."""
PICTURE_SIDE, MAX_ENLARGEMENT = 600, 2
"""The mesh's own mask is drawn with about so many pixels, since it has no soft edge."""
SAMPLES_PER_PIXEL = 4
MAX_REACH_PX = 40.0
"""Pixels on either side of a point in which an edge is looked for; a close camera's are many."""


def outline_offsets(
    camera: Camera, mask: np.ndarray, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, normals: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Meters (N,) by which points would have to move along their normals for the mesh to fill the
    mask; and (N,) bool for which points this is known: those near the outline of the mesh, with one
    edge of the mask near them.

    mask (H, W) uint8, 255 inside; points on the mesh and unit normals (N, 3); reach: the largest
    move, in meters. Both outlines are crossed along the projected normal, so that a point need not
    lie on the outline itself.
    """
    found, known = np.zeros(len(points)), np.zeros(len(points), bool)
    rows = np.flatnonzero(np.abs(facing(camera, points, normals)) < MAX_COSINE)
    (begin, depth), (end, _) = (
        camera.project(points[rows]),
        camera.project(points[rows] + 1e-3 * normals[rows]),
    )
    along = 1e3 * (end - begin)  # pixels per meter
    length = np.linalg.norm(along, axis=1)
    usable = (depth > 0) & (length * reach > 1)
    if not usable.any():
        return found, known
    rows, begin, along, length = rows[usable], begin[usable], along[usable], length[usable]
    pixels = min(float(length.max()) * reach, MAX_REACH_PX)
    steps = np.linspace(-pixels, pixels, 2 * math.ceil(SAMPLES_PER_PIXEL * pixels) + 1)
    at = begin[:, None] + steps[:, None] * (along / length[:, None])[:, None]
    factor = int(np.clip(PICTURE_SIDE / max(camera.width, camera.height), 1, MAX_ENLARGEMENT))
    rim = _rim(camera, vertices, faces, begin, pixels)
    drawn = (rasterize(vertices, rim, camera.scaled(factor))[0] >= 0).astype(np.float32)
    wanted, own = _edge(mask / np.float32(255), at, steps), _last_edge(drawn, factor * at, steps)
    move = (wanted - own) / length
    inside = np.abs(np.nan_to_num(move, nan=np.inf)) <= reach
    found[rows[inside]], known[rows[inside]] = move[inside], True
    return found, known


def _rim(
    camera: Camera, vertices: np.ndarray, faces: np.ndarray, around: np.ndarray, pixels: float
) -> np.ndarray:
    """The triangles (R, 3) of the outline near the pixels `around` (N, 2): most of the mesh need
    not be drawn."""
    from scipy.spatial import cKDTree

    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    rows = np.flatnonzero(np.abs(facing(camera, (a + b + c) / 3, normal)) < RIM_COSINE)
    corners = camera.project(vertices)[0][faces[rows]]
    center = corners.mean(1)
    radius = np.linalg.norm(corners - center[:, None], axis=2).max(1)
    distance, _ = cKDTree(around).query(np.nan_to_num(center, nan=1e9))
    return np.asarray(faces[rows[distance < pixels + radius]])


def _edge(mask: np.ndarray, at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Step (N,) at which lines of pixels `at` (N, S, 2) leave a mask (H, W) from 0 to 1; NaN unless
    they do so once."""
    level = _sampled(mask, at)
    crossings = (level[:, :-1] > 0) != (level[:, 1:] > 0)
    return _crossed(level, crossings.argmax(1), steps, (crossings.sum(1) == 1) & (level[:, 0] > 0))


def _last_edge(mask: np.ndarray, at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """As `_edge`, of a mask with holes: the last step at which a line leaves it; NaN where it ends
    inside."""
    level = _sampled(mask, at)
    leaves = (level[:, :-1] > 0) & (level[:, 1:] <= 0)
    last = leaves.shape[1] - 1 - leaves[:, ::-1].argmax(1)
    return _crossed(level, last, steps, leaves.any(1) & (level[:, -1] <= 0))


def _sampled(mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Mask (H, W) at pixels (N, S, 2), minus a half."""
    from scipy.ndimage import map_coordinates

    found = map_coordinates(
        mask, [at[..., 1] - 0.5, at[..., 0] - 0.5], np.float32, order=1, mode="nearest"
    )
    return np.asarray(found - 0.5)


def _crossed(
    level: np.ndarray, last: np.ndarray, steps: np.ndarray, valid: np.ndarray
) -> np.ndarray:
    """Step (N,) at which levels (N, S) pass zero between `last` (N,) and the next; NaN where not
    valid."""
    row = np.arange(len(level))
    before, after = level[row, last], level[row, last + 1]
    share = before / np.where(valid, before - after, 1)
    return np.where(valid, steps[last] + share * (steps[1] - steps[0]), np.nan)
