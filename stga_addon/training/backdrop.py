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
        mesh = np.asarray(capture.mesh(view.timestep))
        mask = 255 * silhouette(mesh, capture.faces, view.camera).astype(np.uint8)
    return over_color(image, mask, background), mask


def over_color(image: np.ndarray, mask: np.ndarray, color: Sequence[float]) -> np.ndarray:
    """The masked part of an image (H, W, 3) uint8 over a color (0…1); mask (H, W) uint8 coverage.

    image = coverage · foreground + (1 − coverage) · backdrop, where the backdrop of a pixel is the
    mean of those pixels around it that show nothing else; only this second term is exchanged. A
    mask's soft edge thus keeps no rim of the backdrop's color.
    """
    from scipy.ndimage import gaussian_filter

    cover = mask[..., None].astype(np.float32) / 255
    rest = (1 - cover) * 255 * np.asarray(color, np.float32)
    found = cover * image
    edge = (mask > 0) & (mask < 255)
    if edge.any() and not mask.all():
        margin = round(3 * BLUR_SHARES[1] * len(image))
        spans = [np.flatnonzero(edge.any(axis=axis)) for axis in (1, 0)]
        box = tuple(slice(max(0, int(s[0]) - margin), int(s[-1]) + margin + 1) for s in spans)
        part, share, clear = image[box].astype(np.float32), cover[box], mask[box] == 0
        total, weight = np.zeros_like(part), np.full_like(share, 1e-12)
        shown = np.where(clear[..., None], part, 0)
        for blur, importance in zip(BLUR_SHARES, (1.0, FAR_WEIGHT), strict=True):
            sigma = max(1.0, blur * len(image))
            total += importance * gaussian_filter(shown, (sigma, sigma, 0), truncate=3.0)
            near = gaussian_filter(clear.astype(np.float32), sigma, truncate=3.0)
            weight += importance * near[..., None]
        foreground = np.clip(part - (1 - share) * (total / weight), 0, 255 * share)
        found[box][edge[box]] = foreground[edge[box]]
    return np.asarray(np.clip(found + rest, 0, 255) + 0.5).astype(np.uint8)
