"""Array contract of the rasterizer: the arrays that its stages hand on, with shapes, types and
units.

Stages: `project` (splats to the screen), `tiles` (which splats reach which tile), `blend` (tiles to
pixels), and `image_loss`; each forward and, but for `tiles`, backward. The kernels take one tuple
of arrays per concern, float32 unless said; `gpu/layout.py` says what of it the GPU's tables hold.

N splats, F triangles, K = (degree + 1)² SH coefficients, P (tile, splat) pairs, image H × W.
Gradients of a scalar have the name of the quantity after `v_`.
"""

from typing import Any, NamedTuple

import numpy as np

TILE = 16
"""Side of a tile, pixels. Tiles are numbered row by row."""
PIXELS = TILE * TILE

# Columns of a projected splat, and of the gradient of one (tile, splat) pair. Alpha at the offset
# (dx, dy) from MEAN is OPACITY · exp(−½ · (PRECISION_X·(dx − SHEAR·dy)² + PRECISION_Y·dy²)). The
# known three entries of the inverse covariance lose the small one of a long needle, and with it the
# sign of the exponent; squares cannot.
MEAN_X, MEAN_Y, PRECISION_X, SHEAR, PRECISION_Y, OPACITY, RED, GREEN, BLUE = range(9)
PROJECTED = 9


class Parameters(NamedTuple):
    """What is trained of N splats, raw as in `Splats`: numpy arrays, in `autograd` torch tensors.

    xyz (N, 3), rotation (N, 4) wxyz, log_scale (N, 3), opacity (N,) logit, sh (N, K, 3). The
    triangles (N,) int32 that the splats are bound to are passed beside them.
    """

    xyz: Any
    rotation: Any
    log_scale: Any
    opacity: Any
    sh: Any


class CameraFrames(NamedTuple):
    """Frames of the triangles in camera space, and the camera: camera point = matrix @ local point
    + origin.

    origin (F, 3) meters, matrix (F, 3, 3) with the triangle's scale in it, color (F, 3) added to
    that of its splats, or (·, 0) where nothing is; to_world (3, 3) rotation from camera to world;
    intrinsics (4,) fl_x, fl_y, cx, cy in pixels; size (2,) int64 width, height.
    """

    origin: np.ndarray
    matrix: np.ndarray
    color: np.ndarray
    to_world: np.ndarray
    intrinsics: np.ndarray
    size: np.ndarray


class Projection(NamedTuple):
    """N splats on the screen.

    columns (N, PROJECTED); depth (N,) meters along the view axis; extent_y (N,) half height in
    pixels up to alpha = 1/255; rect (N, 4) int32 bounds x0, y0, x1, y1 in tiles: all 0 for a splat
    that is not visible, all −1 for one that is not finite or would be wider than float32 can square
    (some 1e9 pixels). The other three are undefined for a splat that is not visible.
    """

    columns: np.ndarray
    depth: np.ndarray
    extent_y: np.ndarray
    rect: np.ndarray


class TileLists(NamedTuple):
    """The (tile, splat) pairs, by tile and by splat.

    visible (M,) int32: the splats with a pair. start (tiles + 1,) int64: where each tile's pairs
    begin; pair_splat (P,)
    int32: the splat of each pair, front to back within a tile. Splat i's pairs are
    splat_pairs[first_pair[i] : first_pair[i] + pairs[i]], all int32.
    """

    visible: np.ndarray
    first_pair: np.ndarray
    pairs: np.ndarray
    splat_pairs: np.ndarray
    start: np.ndarray
    pair_splat: np.ndarray


class Blended(NamedTuple):
    """The image, and what the backward pass of blending needs.

    image (3, H, W) over the background; transmittance (H, W) = 1 − alpha, whose small values alpha
    would round away;
    last (H, W) int32: one past the pixel's last contributing pair, counted from its tile's first.
    pair_blocks (P,)
    uint16: the blocks of the tile that the splat may reach, a bit each; undefined for pairs behind
    all of a tile's pixels.
    """

    image: np.ndarray
    transmittance: np.ndarray
    last: np.ndarray
    pair_blocks: np.ndarray


def rows_by_triangle(face: np.ndarray, triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """The splats on each triangle, in order: where each one's begin (triangles + 1,) int64, and
    their numbers (N,) int32; face (N,): the triangle of each splat."""
    rows = np.argsort(face, kind="stable")
    starts = np.searchsorted(face[rows], np.arange(triangles + 1))
    return starts.astype(np.int64), rows.astype(np.int32)
