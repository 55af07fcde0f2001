"""One person's motion on another's head: relative to neutral faces, and within what the head was trained on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..capture.model import evenly_spread
from ..errors import StgaError
from ..flame.forward import FlameFrame
from .performance import Performance

PART_FIELDS = {"face": "expr", "jaw": "jaw_pose", "eyes": "eyes_pose"}
"""Part of a face -> field of a frame that holds it."""
QUIET_SHARE, MAX_COMPARED_FRAMES = 0.2, 1000
"""Share of the frames that count as quiet: those most alike, or of least weight; and how many are compared."""
NEUTRALS = {
    "none": "as recorded",
    "quiet": "both recordings are at rest in the fifth of their frames that are most alike",
    "first": "both recordings begin at rest",
    "calibrated": "the motion is relative to the performer's resting face already",
}
MIN_WIDTH = {"face": 0.5, "jaw": 0.02, "eyes": 0.1}
"""Least half width of a trained range, in units of coefficients and in radians."""
OUTER_QUANTILE = 0.01
"""Of the trained frames, cut off at both ends of the range: single mistracked frames widen nothing."""


@dataclass(frozen=True)
class TrainedRange:
    """Middle and half width, per part of the face (`PART_FIELDS`), of the parameters that an avatar was trained on;
    quiet and first: the trained person's own quiet face, and that of the first frame."""

    middle: dict[str, np.ndarray]
    width: dict[str, np.ndarray]
    quiet: dict[str, np.ndarray]
    first: dict[str, np.ndarray]

    def neutral(self, choice: str) -> dict[str, np.ndarray]:
        """The face on which a motion is put that is relative to another neutral, one of `NEUTRALS` but "none"."""
        return self.first if choice == "first" else self.quiet


def trained_range(frames: Sequence[FlameFrame]) -> TrainedRange:
    """The range of the frames that an avatar was trained on."""
    middle, width = {}, {}
    for part, field in PART_FIELDS.items():
        values = np.stack([getattr(frame, field) for frame in frames])
        low, high = np.quantile(values, [OUTER_QUANTILE, 1 - OUTER_QUANTILE], axis=0)
        middle[part], width[part] = (low + high) / 2, np.maximum((high - low) / 2, MIN_WIDTH[part])
    return TrainedRange(middle, width, quiet_neutral(frames), quiet_neutral(frames[:1]))


def quiet_neutral(frames: Sequence[FlameFrame]) -> dict[str, np.ndarray]:
    """Part -> the median of its parameters over the frames that are most alike: a face keeps returning to rest.

    Needs no order in time, which recordings of single expressions lack.
    """
    frames = evenly_spread(frames, MAX_COMPARED_FRAMES)
    parts = {part: np.stack([getattr(frame, field) for frame in frames]) for part, field in PART_FIELDS.items()}
    face = np.concatenate([parts["face"], parts["jaw"]], axis=1)
    squares = (face**2).sum(axis=1)
    apart = squares[:, None] + squares - 2 * face @ face.T
    count = max(1, round(QUIET_SHARE * len(face)))
    center = np.sort(apart, axis=1)[:, :count].sum(axis=1).argmin()
    quiet = np.argsort(apart[center], kind="stable")[:count]
    return {part: np.median(values[quiet], axis=0) for part, values in parts.items()}


def quiet_weights(performance: Performance) -> np.ndarray:
    """(52,) median of the weights over the rows in which their sum is least."""
    order = np.argsort(performance.weights.sum(axis=1), kind="stable")
    return np.asarray(np.median(performance.weights[order[: max(1, round(QUIET_SHARE * len(order)))]], axis=0))


def chosen_neutral(where: str, choice: str) -> str:
    """The choice. Raises StgaError where it is none of `NEUTRALS`."""
    if choice not in NEUTRALS:
        raise StgaError(f"{where}: neutral is {choice!r}, expected one of {', '.join(NEUTRALS)}")
    return choice


def exchanged_neutral(
    frames: Sequence[FlameFrame],
    theirs: dict[str, np.ndarray] | None = None,
    own: dict[str, np.ndarray] | None = None,
) -> list[FlameFrame]:
    """The frames with this head's neutral in place of the other person's, part by part; None: a neutral of zeros.

    Parameters of the parts are subtracted and added, rotations as axis-angle: jaw and eyes turn by small angles.
    """
    change = {
        field: (0.0 if own is None else own[part]) - (0.0 if theirs is None else theirs[part])
        for part, field in PART_FIELDS.items()
    }
    return [replace(f, **{field: getattr(f, field) + value for field, value in change.items()}) for f in frames]


def outside(frames: Sequence[FlameFrame], trained: TrainedRange) -> dict[str, np.ndarray]:
    """Part -> (T,) how far outside the trained range each frame is: 0 inside, 1 where it is twice as far from the
    middle as the range reaches, for the parameter that is farthest."""
    found = {}
    for part, field in PART_FIELDS.items():
        values = np.stack([getattr(frame, field) for frame in frames])
        reach = np.abs(values - trained.middle[part]) / trained.width[part]
        found[part] = np.maximum(reach.max(axis=1, initial=0) - 1, 0)
    return found


def led_back(frames: Sequence[FlameFrame], trained: TrainedRange, strength: float = 1.0) -> list[FlameFrame]:
    """The frames with parameters beyond the trained range led back to it; strength 0: unchanged, 1: fully.

    Inside the range nothing changes; beyond it, a distance of d half widths becomes 1 − exp(−d) quarters of one, so
    that motion goes on softly. Between 0 and 1 the result lies between both.
    """
    changed = []
    for frame in frames:
        values = {}
        for part, field in PART_FIELDS.items():
            middle, width = trained.middle[part], trained.width[part]
            offset = (getattr(frame, field) - middle) / width
            beyond = np.maximum(np.abs(offset) - 1, 0)
            soft = np.sign(offset) * (np.minimum(np.abs(offset), 1) + 0.25 * (1 - np.exp(-beyond)))
            values[field] = middle + width * ((1 - strength) * offset + strength * soft)
        changed.append(replace(frame, **values))
    return changed
