"""Where a person is in an image: MediaPipe's selfie segmentation, whose network is in its wheel."""

import os
import sys
from typing import Any, Protocol

import numpy as np

from ..errors import StgaError


class PersonSegmenter(Protocol):
    """Tells people from what is behind them."""

    def probability(self, image: np.ndarray) -> np.ndarray:
        """(H, W) float32 in 0…1 of an image (H, W, 3) uint8: how likely each pixel shows a person."""


class SelfieSegmentation:
    """MediaPipe's network of 250 kB (versions before 0.10.30), which sees 256×256 pixels: no download."""

    def __init__(self, solutions: Any) -> None:
        self._network = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)

    def probability(self, image: np.ndarray) -> np.ndarray:
        return np.asarray(self._network.process(np.ascontiguousarray(image)).segmentation_mask, np.float32)


def make_segmenter() -> PersonSegmenter:
    """Raises StgaError, in one sentence, where mediapipe or its network is not available."""
    os.environ.setdefault("GLOG_minloglevel", "2")  # its C++ part reports its own progress on stderr
    try:
        import mediapipe
    except ImportError as error:
        raise StgaError(_needs(f"which {sys.executable} lacks")) from error
    if not hasattr(mediapipe, "solutions"):
        raise StgaError(_needs(f"and {mediapipe.__version__} has no network in its wheel"))
    return SelfieSegmentation(mediapipe.solutions)


def _needs(what: str) -> str:
    return (
        f"mattes need mediapipe==0.10.21 (Python 3.11 or 3.12), {what}: give a folder of mattes with --mattes, a clean "
        "plate of each camera, or masks beside the images"
    )
