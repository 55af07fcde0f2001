"""Driven offsets: coefficients of each triangle, trained, by which its splats follow a signal of
the pose."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from .embedding import FaceFrames, shifted_frames
from .strain import STRAIN_COMPONENTS, StrainBasis, smoothed_strain

Signal = Callable[[StrainBasis, FaceFrames], np.ndarray]
"""(F, S) float32 of a posed mesh's triangles, from the neutral mesh's basis and the frames; 0 where
it is at rest."""


@dataclass(frozen=True)
class DrivenOffset:
    """A row of OFFSETS: a triangle's splats move by signal (S,) · coefficients (S, 3), in its own
    frame.

    name        of the coefficients (F, S, 3) in settings, avatar files and checkpoints
    signals     S
    signal      what drives it
    rate_share  learning rate per unit of the signal, as a share of that of the splats' positions
    """

    name: str
    signals: int
    signal: Signal
    rate_share: float


STRAIN_POSITION = DrivenOffset(
    "strain_position",
    STRAIN_COMPONENTS,
    lambda basis, frames: smoothed_strain(basis, frames.strain),
    rate_share=0.5,
)
"""Positions that follow the strain around their triangle: skin that is compressed bulges."""
OFFSETS: dict[str, DrivenOffset] = {offset.name: offset for offset in (STRAIN_POSITION,)}
"""By name. Everything that trains, stores or poses avatars goes by this table."""


def offset_of(coefficients: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """(F, 3) for `shifted_frames`: coefficients (F, S, 3) times signal (F, S)."""
    return np.asarray(np.einsum("fk,fkc->fc", signal, coefficients))


def moved_frames(
    frames: FaceFrames, coefficients: Mapping[str, np.ndarray], signal: Callable[[str], np.ndarray]
) -> FaceFrames:
    """The frames, moved by every driven offset of which there are coefficients; signal: name -> (F,
    S)."""
    for name, values in coefficients.items():
        frames = shifted_frames(frames, offset_of(values, signal(name)))
    return frames
