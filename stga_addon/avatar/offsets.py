"""Driven offsets: coefficients of each triangle, trained, by which positions and colors of its
splats follow a signal of the pose."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from .embedding import FaceFrames
from .strain import STRAIN_COMPONENTS, StrainBasis, smoothed_strain

SIGNALS: dict[str, Callable[[StrainBasis, FaceFrames], np.ndarray]] = {
    "smoothed_strain": lambda basis, frames: smoothed_strain(basis, frames.deformation),
    "normal": lambda basis, frames: frames.deformation[:, STRAIN_COMPONENTS:],
}
"""Name -> (F, 3) float32 of a posed mesh's triangles, from the neutral mesh's basis and the frames;
0 where it is at rest. "normal": the change of the unit normal, world axes."""
POSITION = "position"
"""Target of an offset that moves splats, in the triangle's own axes and unit."""
SCALE = "scale"
"""Target of an offset that is added to the logarithm of a splat's size."""
COLOR = "color"
"""Target of an offset that is added to colors (sRGB)."""
TARGETS = (POSITION, SCALE, COLOR)
"""Targets in the order of their numbers in the kernels (`raster.cpu.project`)."""

MAX_ENLARGEMENT = 3.0
"""Factor by which a signal may enlarge any splat: 99 % of the triangles of one `studio_head` run
changed their splats' size by less in filmed poses."""
MAX_ENLARGED_M = 0.015
"""Standard deviation (m) up to which a signal may enlarge a splat by more than MAX_ENLARGEMENT. A
splat of `studio_head` would reach .2 m without this limit, costing unseen expressions .01 dB."""


@dataclass(frozen=True)
class DrivenOffset:
    """A row of OFFSETS: a triangle's splats change by signal (3,) · coefficients (3, 3).

    name        of the coefficients (F, 3, 3) in settings, avatar files and checkpoints
    signal      what drives it, of SIGNALS
    target      POSITION: by a vector in the triangle's own axes and unit; SCALE: that unit, by the
                exponential of the first component; COLOR: sRGB
    rate, rate_fraction  learning rate: which of `Rates`, and a fraction of it
    of_light    whether it is the capture's light, which other light takes the place of
    """

    name: str
    signal: str
    target: str
    rate: str
    rate_fraction: float
    of_light: bool = False


OFFSETS: dict[str, DrivenOffset] = {
    offset.name: offset
    for offset in (
        DrivenOffset("strain_position", "smoothed_strain", POSITION, "xyz", 0.5),
        DrivenOffset("strain_scale", "smoothed_strain", SCALE, "log_scale", 0.5),
        DrivenOffset("strain_color", "smoothed_strain", COLOR, "strain_color", 0.8),
        DrivenOffset("normal_color", "normal", COLOR, "strain_color", 0.4, of_light=True),
    )
}
"""Name -> driven offset. Everything that trains, stores or poses avatars uses this table.
Compressed skin bulges and darkens, splats on stretched skin become larger, and skin that turns in a
fixed light becomes brighter or darker."""


def offset_of(coefficients: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """(F, 3): coefficients (F, S, 3) times signal (F, S)."""
    return np.einsum("fk,fkc->fc", signal, coefficients)


def limited_enlargement(
    coefficients: np.ndarray, signals: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Coefficients (F, S, 3) of a SCALE offset, made smaller where a pose that was never filmed
    could blow a splat up.

    signals (2, F, S): lowest and highest of each component. Filmed poses combine them as faces do;
    others may combine all of the extremes. size (F,) meters: the largest standard deviation of a
    triangle's splats at rest.
    """
    enlargement = np.maximum(*(signals * coefficients[..., 0])).sum(1)
    limit = np.log(np.maximum(MAX_ENLARGEMENT, MAX_ENLARGED_M / np.maximum(size, 1e-9)))
    return (
        coefficients * np.minimum(1, limit / np.maximum(enlargement, limit))[:, None, None]
    ).astype(coefficients.dtype)


def moved_frames(
    frames: FaceFrames, coefficients: Mapping[str, np.ndarray], signal: Callable[[str], np.ndarray]
) -> FaceFrames:
    """The frames, moved, scaled and colored by every driven offset of which there are coefficients;
    signal: name of SIGNALS -> (F, 3)."""
    color = np.zeros((len(frames.scale), 3), np.float32)
    unit = frames.scale
    for name, values in coefficients.items():
        offset = OFFSETS[name]
        change = offset_of(values, signal(offset.signal))
        if offset.target == COLOR:
            color += change
            frames = replace(frames, color=color)
        elif offset.target == SCALE:
            frames = replace(frames, scale=frames.scale * np.exp(change[:, 0].astype(np.float64)))
        else:
            # In one type: einsum takes several times as long where it has to convert.
            turned = np.einsum("fij,fj->fi", frames.rotation, change.astype(np.float64))
            frames = replace(frames, origin=frames.origin + unit[:, None] * turned)
    return frames
