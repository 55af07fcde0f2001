"""Detail difference: how much more or less fine structure an image has than another, wherever exactly it lies."""

import numpy as np
from scipy.ndimage import prewitt, uniform_filter

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
PREWITT_SUM = 3
"""Sum of the positive weights of Prewitt's filter."""
WINDOW_PX = 7
"""Side of the window that detail is averaged over, so that a hair a pixel beside its place counts as a hair."""
NOISE_LEVEL = 0.02
"""Change of luma (0…1) from pixel to pixel below which detail counts little."""


def detail_difference(image: np.ndarray, target: np.ndarray, where: np.ndarray | None = None) -> float:
    """Mean of |a − b| / (a + b + NOISE_LEVEL) over the pixels `where` (H, W) if given; 0 for equal images, below 1.

    image (3, H, W) float32 in 0…1, target (H, W, 3) uint8; a and b are their mean gradients of luma around a pixel.
    It falls with LPIPS during training, also where PSNR falls, and needs no weights.
    """
    first = _local_gradient(np.tensordot(LUMA, image, 1))
    second = _local_gradient(target @ LUMA / np.float32(255))
    difference = abs(first - second) / (first + second + NOISE_LEVEL)
    return float(difference.mean() if where is None else difference[where].mean())


def _local_gradient(luma: np.ndarray) -> np.ndarray:
    """Length of Prewitt's gradient of an image (H, W), averaged over a window."""
    return np.asarray(uniform_filter(np.hypot(prewitt(luma, 0), prewitt(luma, 1)) / PREWITT_SUM, WINDOW_PX))
