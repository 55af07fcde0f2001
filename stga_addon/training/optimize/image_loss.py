"""Image loss of training and its gradient, on the CPU (STGA, training)."""

from functools import cache
from itertools import pairwise

import numpy as np

from ...raster.cpu.image_loss import LOSS_REACH_PX, image_loss
from ...raster.cpu.layout import TILE
from ...raster.cpu.threads import PROCESSORS, threads
from ...raster.cpu.tiles import box_groups

BAND_TILES = 4
"""A rectangle of a local iteration is not cut into fewer rows of tiles; each computes 20 rows of
pixels more."""


@cache
def _bands(height: int, count: int) -> int:
    """How many bands cost the busiest of `count` threads the fewest rows."""
    fewest = -(-count // 2)
    most = 2 * count
    beyond = 2 * LOSS_REACH_PX
    return min(
        range(fewest, most + 1), key=lambda n: -(-3 * n // count) * (-(-height // n) + beyond)
    )


def whole_image(height: int, width: int, bands: int | None = None) -> np.ndarray:
    """Rectangles (R, 4) of pixels x0, y0, x1, y1 that tile an image; each channel of one is one
    thread's work. bands: how many, over the whole width, because pixels beyond left and right edges
    cost more; by default, so many that the threads are done soonest."""
    count = min(bands or _bands(height, min(threads(), PROCESSORS)), height)
    tops = [height * n // count for n in range(count + 1)]
    return np.array([[0, y0, width, y1] for y0, y1 in pairwise(tops)], np.int64)


def tile_rectangles(tiles: np.ndarray, height: int, width: int) -> np.ndarray:
    """Rectangles (R, 4) of pixels around each connected group of marked tiles (rows, columns) bool,
    the largest first; those of more rows than a thread's part, or BAND_TILES, are cut."""
    fraction = -(-int(tiles.any(1).sum()) // min(threads(), PROCESSORS))
    boxes = box_groups(tiles, max(BAND_TILES, fraction))
    largest_first = np.argsort((boxes[:, 0] - boxes[:, 2]) * (boxes[:, 3] - boxes[:, 1]))
    return np.minimum(boxes[largest_first] * TILE, [width, height, width, height])


def image_gradient(
    image: np.ndarray,
    target: np.ndarray,
    rectangles: np.ndarray,
    ssim_weight: float,
    out: np.ndarray,
) -> tuple[float, float]:
    """Write the gradient of (1 − w)·L1 + w·(1 − SSIM) with respect to the image into `out`, within
    the rectangles; of means over the whole image. Returns L1 and SSIM within the rectangles.

    image, out (3, H, W) float32; target (H, W, 3) uint8.
    """
    sums = np.zeros((2, 3, sum(y1 - y0 for _, y0, _, y1 in rectangles.tolist())))
    totals = np.zeros(2)
    fraction = 1.0 / image.size
    factors = np.float32(ssim_weight), np.float32(fraction)
    image_loss(image, target, rectangles, *factors, out, sums, totals)
    l1, ssim = totals.tolist()
    return l1 * fraction, ssim * fraction


def mean_ssim(image: np.ndarray, target: np.ndarray) -> float:
    """Mean SSIM of image (3, H, W) float32 and target (H, W, 3) uint8."""
    unused = np.empty_like(image)
    _, height, width = image.shape
    return image_gradient(image, target, whole_image(height, width), 1.0, unused)[1]
