"""Exposure of a held-out view: gain and offset per channel that match a rendering to it before it is measured."""

import numpy as np

PRIOR_SHARE = 1e-3
"""Weight of the prior (gain 1, offset 0), as a share of the fitted pixels; decides where a rendering is one color."""


def match_exposure(
    image: np.ndarray, target: np.ndarray, head: np.ndarray | None = None, fitted: np.ndarray | None = None
) -> np.ndarray:
    """The rendering with gain and offset per channel fitted to the target: (3, H, W) float32, clipped to 0…1.

    image (3, H, W) float32 in 0…1; target (H, W, 3) uint8; head (H, W) bool where the correction applies, as in
    training not behind the head; fitted (H, W) bool, the pixels that the least squares are over. None: all pixels.
    A run corrects its training cameras only, so the exposure of any other view is unknown to it. The same is done by
    RawNeRF and, as `cc_psnr`, by gsplat with a full color matrix; here it is the model that training inverts.
    """
    head = np.ones(image.shape[1:], bool) if head is None else head
    fitted = head if fitted is None else fitted
    x, y = image[:, fitted].astype(np.float64), target[fitted].T.astype(np.float64) / 255
    if not x.size:
        return image
    prior = PRIOR_SHARE * x.shape[1]
    matched = image.copy()
    for channel, (drawn, seen) in enumerate(zip(x, y, strict=True)):
        inner = np.array([[drawn @ drawn, drawn.sum()], [drawn.sum(), len(drawn)]]) + prior * np.eye(2)
        difference = seen - drawn
        gain, offset = np.linalg.solve(inner, [drawn @ difference, difference.sum()])
        matched[channel, head] += np.float32(gain) * image[channel, head] + np.float32(offset)
    return np.clip(matched, 0, 1)
