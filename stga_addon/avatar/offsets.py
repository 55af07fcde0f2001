"""Driven offsets: coefficients of each triangle, trained, by which its splats follow a signal of
the pose."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from .embedding import FaceFrames
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
    "strain_position", STRAIN_COMPONENTS,
    lambda basis, frames: smoothed_strain(basis, frames.strain), rate_share=0.5,
)  # fmt: skip
"""Positions that follow the strain around their triangle: skin that is compressed bulges."""
OFFSETS: dict[str, DrivenOffset] = {offset.name: offset for offset in (STRAIN_POSITION,)}
"""By name. Everything that trains, stores or poses avatars goes by this table."""


def offset_of(coefficients: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """(F, 3) in each triangle's own axes and unit: coefficients (F, S, 3) times signal (F, S)."""
    return np.asarray(np.einsum("fk,fkc->fc", signal, coefficients))


def moved_frames(
    frames: FaceFrames, coefficients: Mapping[str, np.ndarray], signal: Callable[[str], np.ndarray]
) -> FaceFrames:
    """The frames, moved by every driven offset of which there are coefficients; signal: name -> (F,
    S)."""
    for name, values in coefficients.items():
        # In one type: einsum takes several times as long where it has to convert.
        shift = offset_of(values, signal(name)).astype(np.float64)
        turned = np.einsum("fij,fj->fi", frames.rotation, shift)
        frames = replace(frames, origin=frames.origin + frames.scale[:, None] * turned)
    return frames
