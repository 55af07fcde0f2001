"""What lies behind the head in the images: taken away by masks or, without masks, by the tracked
mesh."""

from collections.abc import Sequence

import numpy as np

from ..capture.mesh_geometry import silhouette
from ..capture.model import Capture, View

BACKDROPS = ("plain", "masked", "mesh")
"""plain: one color, that of the settings' background; masked: anything, replaced by that color
outside the masks; mesh: the same, and images without a mask have the tracked mesh's silhouette for
one."""
BLUR_SHARES = (0.01, 0.05)
"""Standard deviations of the neighborhoods that a pixel's backdrop is the mean of, as shares of the
image's height: the larger one counts where the smaller one holds no backdrop."""
FAR_WEIGHT = 1e-3


def without_backdrop(
    capture: Capture,
    view: View,
    image: np.ndarray,
    mask: np.ndarray | None,
    backdrop: str,
    background: Sequence[float],
) -> tuple[np.ndarray, np.ndarray | None]:
    """Image (H, W, 3) uint8 and mask (H, W) uint8 as training sees them: over the color
    `background` (0…1).

    view: with a camera of the image's size; backdrop: one of BACKDROPS. "plain" images are returned
    as they are.
    """
    if backdrop == "plain" or (mask is None and backdrop == "masked"):
        return image, mask
    if mask is None:
        mask = 255 * silhouette(
            np.asarray(capture.mesh(view.timestep)), capture.faces, view.camera
        ).astype(np.uint8)
    return over_color(image, mask, background), mask


def over_color(image: np.ndarray, mask: np.ndarray, color: Sequence[float]) -> np.ndarray:
    """The masked part of an image (H, W, 3) uint8 over a color (0…1); mask (H, W) uint8 coverage.

    image = coverage · foreground + (1 − coverage) · backdrop, where the backdrop of a pixel is the
    mean of those pixels around it that show nothing else; only this second term is exchanged. A
    mask's soft edge thus keeps no rim of the backdrop's color.
    """
    cover = mask[..., None].astype(np.float32) / 255
    rest = (1 - cover) * 255 * np.asarray(color, np.float32)
    found = cover * image
    edge = (mask > 0) & (mask < 255)
    if edge.any() and not mask.all():
        rows, columns = _around(edge, round(3 * BLUR_SHARES[1] * len(image)))
        part, share = image[rows, columns].astype(np.float32), cover[rows, columns]
        foreground = part - (1 - share) * _backdrop(part, mask[rows, columns] == 0, len(image))
        soft = edge[rows, columns]
        found[rows, columns][soft] = np.clip(foreground, 0, 255 * share)[soft]
    return np.asarray(np.clip(found + rest, 0, 255) + 0.5).astype(np.uint8)


def _around(where: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Rows and columns of the box around `where` (H, W) bool, with a margin in pixels."""
    spans = [np.flatnonzero(where.any(axis=axis)) for axis in (1, 0)]
    rows, columns = (
        slice(max(0, int(span[0]) - margin), int(span[-1]) + margin + 1) for span in spans
    )
    return rows, columns


def _backdrop(image: np.ndarray, clear: np.ndarray, height: int) -> np.ndarray:
    """(H, W, 3) mean color of the pixels `clear` (H, W) bool around each pixel of an image (H, W,
    3) float32; height: of the whole image."""
    from scipy.ndimage import gaussian_filter

    total, weight = np.zeros_like(image), np.full((*clear.shape, 1), 1e-12, np.float32)
    shown = np.where(clear[..., None], image, 0)
    for share, importance in zip(BLUR_SHARES, (1.0, FAR_WEIGHT), strict=True):
        sigma = max(1.0, share * height)
        total += importance * gaussian_filter(shown, (sigma, sigma, 0), truncate=3.0)
        weight += (
            importance * gaussian_filter(clear.astype(np.float32), sigma, truncate=3.0)[..., None]
        )
    return np.asarray(total / weight)
