"""Images of unlike cameras, as the mean of them would have taken them."""

from collections.abc import Callable

import numpy as np

from ...capture.model import View
from ..settings import TrainingSettings

Correction = Callable[[View, np.ndarray, np.ndarray | None], np.ndarray]
"""View, image (H, W, 3) uint8 and mask (H, W) uint8 or None -> the image to train on."""


def exposure_correction(settings: TrainingSettings) -> Correction | None:
    """What takes the settings' `exposure` away from the images of training cameras; None where there is none.

    Only the foreground passed through the camera: what the mask says is background keeps its colour. Cameras that
    the settings do not name stay as they are.
    """
    if not settings.exposure:
        return None
    rows = {int(row[0]): np.array(row[1:], np.float32).reshape(2, 3) for row in settings.exposure}
    background = 255 * np.array(settings.background, np.float32)

    def correct(view: View, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        if view.camera_index not in rows:
            return image
        gain, offset = rows[view.camera_index]
        cover = np.float32(1) if mask is None else mask[..., None].astype(np.float32) / 255
        behind = (1 - cover) * background
        even = (image - behind - cover * offset) / gain + behind
        return np.asarray(np.clip(even, 0, 255) + 0.5).astype(np.uint8)

    return correct
