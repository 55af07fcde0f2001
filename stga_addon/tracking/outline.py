"""Where a surface's outline lies in the masks of calibrated cameras."""

import math

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_raster import rasterize
from .photo_consistency import facing

MAX_COSINE = 0.25
"""Of the angle between normal and camera: points within 15° of the outline move it."""
PICTURE_SIDE, MAX_ENLARGEMENT = 600, 2
"""The mesh's own mask is drawn with about so many pixels, since it has no soft edge."""
SAMPLES_PER_PIXEL = 4
MAX_REACH_PX = 40.0


def outline_offsets(
    camera: Camera, mask: np.ndarray, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, normals: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Meters (N,) by which points would have to move along their normals for the mesh to fill the mask; and (N,) bool
    for which points this is known: those near the outline of the mesh, with one edge of the mask near them.

    mask (H, W) uint8, 255 inside; points on the mesh and unit normals (N, 3); reach: the largest move, in meters.
    Both outlines are crossed along the projected normal, so that a point need not lie on the outline itself.
    """
    found, known = np.zeros(len(points)), np.zeros(len(points), bool)
    rows = np.flatnonzero(np.abs(facing(camera, points, normals)) < MAX_COSINE)
    (begin, depth), (end, _) = camera.project(points[rows]), camera.project(points[rows] + 1e-3 * normals[rows])
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
    drawn = (rasterize(vertices, faces, camera.scaled(factor))[0] >= 0).astype(np.float32)
    wanted, own = _edge(mask / np.float32(255), at, steps), _edge(drawn, factor * at, steps)
    move = (wanted - own) / length
    inside = np.abs(np.nan_to_num(move, nan=np.inf)) <= reach
    found[rows[inside]], known[rows[inside]] = move[inside], True
    return found, known


def _edge(mask: np.ndarray, at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Step (N,) at which lines of pixels `at` (N, S, 2) leave a mask (H, W) from 0 to 1; NaN unless they do so once."""
    from scipy.ndimage import map_coordinates

    level = map_coordinates(mask, [at[..., 1] - 0.5, at[..., 0] - 0.5], np.float32, order=1, mode="nearest") - 0.5
    inside = level > 0
    crossings = inside[:, :-1] != inside[:, 1:]
    row, last = np.arange(len(at)), crossings.argmax(1)
    before, after = level[row, last], level[row, last + 1]
    once = (crossings.sum(1) == 1) & inside[:, 0]
    share = before / np.where(once, before - after, 1)
    return np.where(once, steps[last] + share * (steps[1] - steps[0]), np.nan)
