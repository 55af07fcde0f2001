"""What is done to the captured images before they are trained on or compared with."""

import numpy as np

from ...capture.loader import Preparation
from ...capture.model import Capture, View
from ..backdrop import without_backdrop
from ..settings import TrainingSettings
from .exposure import exposure_correction


def image_preparation(capture: Capture, settings: TrainingSettings) -> Preparation | None:
    """Takes away the settings' `backdrop`, then inverts their `exposure`; None where neither changes anything."""
    correct, backdrop, background = exposure_correction(settings), settings.backdrop, settings.background
    if correct is None and backdrop == "plain":
        return None

    def prepare(view: View, image: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        image, mask = without_backdrop(capture, view, image, mask, backdrop, background)
        return (image if correct is None else correct(view, image, mask)), mask

    return prepare
