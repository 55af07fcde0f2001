"""Exposure of a view that is measured: gain and offset per channel, known from training or fitted
to the view."""

from collections.abc import Iterable, Sequence

import numpy as np

from ...capture.model import View, ViewExposure
from ..optimize.image_preparation import view_exposure

PRIOR_SHARE = 1e-3
"""Weight of the prior (gain 1, offset 0), as a share of the fitted pixels; decides where a
rendering is one color."""


NO_CORRECTION = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])


def known_exposure(rows: Sequence[Sequence[float]], training_views: Iterable[View]) -> ViewExposure:
    """Exposure of the training cameras' views.

    rows: `TrainingSettings.exposure`. A camera that they do not list was trained as it is.
    """
    trained, listed = {view.camera_index for view in training_views}, view_exposure(rows)

    def exposure(view: View) -> np.ndarray | None:
        found = listed(view)
        return NO_CORRECTION if found is None and view.camera_index in trained else found

    return exposure


def with_exposure(
    image: np.ndarray, exposure: np.ndarray, head: np.ndarray | None = None
) -> np.ndarray:
    """The rendering (3, H, W) as a camera of this exposure (2, 3) shows it, clipped to 0…1; head as
    below."""
    head = np.ones(image.shape[1:], bool) if head is None else head
    gain, offset = exposure.astype(np.float32)[..., None]
    exposed = image.copy()
    exposed[:, head] = gain * image[:, head] + offset / 255
    return np.clip(exposed, 0, 1)


def exposed_rendering(
    image: np.ndarray,
    target: np.ndarray,
    exposure: np.ndarray | None,
    head: np.ndarray | None = None,
    fitted: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The rendering with a view's exposure (2, 3), or with a fitted one (`match_exposure`) where
    that is None; and the rendering as it is without a fit."""
    if exposure is None:
        return match_exposure(image, target, head, fitted), image
    exposed = with_exposure(image, exposure, head)
    return exposed, exposed


def match_exposure(
    image: np.ndarray,
    target: np.ndarray,
    head: np.ndarray | None = None,
    fitted: np.ndarray | None = None,
) -> np.ndarray:
    """The rendering with gain and offset per channel fitted to the target: (3, H, W) float32,
    clipped to 0…1.

    image (3, H, W) float32 in 0…1; target (H, W, 3) uint8; head (H, W) bool where the correction
    applies, as in training not behind the head; fitted (H, W) bool, the pixels that the least
    squares are over. None: all pixels. A run corrects its training cameras only, so the exposure of
    any other view is unknown to it. The same is done by RawNeRF and, as `cc_psnr`, by gsplat with a
    full color matrix; here it is the model that training inverts.
    """
    head = np.ones(image.shape[1:], bool) if head is None else head
    fitted = head if fitted is None else fitted
    x, y = image[:, fitted].astype(np.float64), target[fitted].T.astype(np.float64) / 255
    if not x.size:
        return image
    prior = PRIOR_SHARE * x.shape[1]
    matched = image.copy()
    for channel, (drawn, seen) in enumerate(zip(x, y, strict=True)):
        total = drawn.sum()
        inner = np.array([[drawn @ drawn, total], [total, len(drawn)]]) + prior * np.eye(2)
        difference = seen - drawn
        gain, offset = np.linalg.solve(inner, [drawn @ difference, difference.sum()])
        matched[channel, head] += np.float32(gain) * image[channel, head] + np.float32(offset)
    return np.clip(matched, 0, 1)
