"""Positions that follow the strain around their triangle: skin that is compressed bulges."""

import numpy as np

from ..embedding import FaceFrames
from ..strain import STRAIN_COMPONENTS, StrainBasis, smoothed_strain
from .offset import DrivenOffset

RATE_SHARE = 0.5


def _signal(basis: StrainBasis, frames: FaceFrames) -> np.ndarray:
    return smoothed_strain(basis, frames.strain)


STRAIN_POSITION = DrivenOffset("strain_position", STRAIN_COMPONENTS, _signal, RATE_SHARE)
