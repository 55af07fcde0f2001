"""Positions that follow the strain around their triangle: skin that is compressed bulges."""

from ..strain import STRAIN_COMPONENTS, smoothed_strain
from .offset import DrivenOffset

RATE_SHARE = 0.5
STRAIN_POSITION = DrivenOffset(
    "strain_position", STRAIN_COMPONENTS, lambda basis, frames: smoothed_strain(basis, frames.strain), RATE_SHARE
)
