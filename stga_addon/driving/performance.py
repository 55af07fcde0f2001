"""A face performance as ARKit weights over time, and what can be done with it before it moves a head."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from .names import ARKIT_SHAPES, COLUMN, PARTS, mirrored_name, part_of

MIRROR = np.array([COLUMN[mirrored_name(name)] for name in ARKIT_SHAPES])
EXCHANGEABLE = ("jaw", "mouth")
"""Pairs of shapes, such as mouthLeft and mouthRight, which receivers report as exchanged by some senders."""
GAP = 1.5
"""Rows farther apart than this many frames have lost some between them."""
SMOOTHING_REACH = 3.0
"""Standard deviations of the smoothing kernel that are summed."""


@dataclass(frozen=True)
class Performance:
    """T rows of one take.

    times    (T,) seconds, ascending from 0; rows that were lost leave gaps
    weights  (T, 52) in the order of `ARKIT_SHAPES`, 0 to 1 at the source
    head     (T, 3) yaw, pitch, roll in radians; None where the source has none
    fps      rows per second where none is lost
    """

    times: np.ndarray
    weights: np.ndarray
    head: np.ndarray | None
    fps: float

    @property
    def lost(self) -> int:
        """Number of rows that are missing between the first and the last."""
        steps = np.diff(self.times) * self.fps
        return int(np.round(steps[steps > GAP] - 1).sum())


def resampled(performance: Performance, fps: float | None = None) -> Performance:
    """The performance at even times, `fps` a second (default: its own), interpolated linearly."""
    rate = performance.fps if fps is None else fps
    count = int(np.floor(performance.times[-1] * rate + 1e-6)) + 1
    times = np.arange(count) / rate
    return replace(
        performance,
        times=times,
        weights=_interpolated(times, performance.times, performance.weights),
        head=None if performance.head is None else _interpolated(times, performance.times, performance.head),
        fps=rate,
    )


def mirrored(performance: Performance) -> Performance:
    """Left and right exchanged; the head's yaw and roll change their signs."""
    head = None if performance.head is None else performance.head * [-1.0, 1.0, -1.0]
    return replace(performance, weights=performance.weights[:, MIRROR], head=head)


def exchanged_sides(performance: Performance, pairs: tuple[str, ...]) -> Performance:
    """jawLeft and jawRight exchanged, mouthLeft and mouthRight, or both (`EXCHANGEABLE`)."""
    weights = performance.weights.copy()
    for pair in pairs:
        left, right = COLUMN[f"{pair}Left"], COLUMN[f"{pair}Right"]
        weights[:, [left, right]] = weights[:, [right, left]]
    return replace(performance, weights=weights)


def smoothed(performance: Performance, seconds: float) -> Performance:
    """Convolved in time by a Gaussian of standard deviation `seconds`; rows must be evenly spaced (`resampled`)."""
    deviation = seconds * performance.fps
    reach = int(np.ceil(SMOOTHING_REACH * deviation))
    if reach < 1:
        return performance
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    kernel /= kernel.sum()

    def convolved(values: np.ndarray) -> np.ndarray:
        padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
        return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)

    head = None if performance.head is None else convolved(performance.head)
    return replace(performance, weights=convolved(performance.weights), head=head)


def amplified(performance: Performance, gains: Mapping[str, float]) -> Performance:
    """Weights times the gain of their part (`names.PARTS`, or "head") or of their own name; 1 where none is given."""
    factors = np.array([gains.get(name, gains.get(part_of(name), 1.0)) for name in ARKIT_SHAPES])
    head = None if performance.head is None else performance.head * gains.get("head", 1.0)
    return replace(performance, weights=performance.weights * factors, head=head)


def relative_to(performance: Performance, rest: Performance) -> Performance:
    """The performance without the face and head rotation of `rest` (its first row), so that these are 0 and a weight of
    1 stays 1."""
    neutral = rest.weights[0]
    head = performance.head
    if head is not None and rest.head is not None:
        head = head - rest.head[0]
    room = np.maximum(1.0 - neutral, 0.1)
    return replace(performance, weights=(performance.weights - neutral) / room, head=head)


def parts_kept(performance: Performance, parts: tuple[str, ...]) -> Performance:
    """The performance with the weights of other parts at zero."""
    return amplified(performance, {part: 1.0 if part in parts else 0.0 for part in (*PARTS, "head")})


def _interpolated(times: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)


@dataclass(frozen=True)
class FacePacket:
    """One frame of a live source.

    names    ARKit shapes that it holds
    weights  (52,) in the order of `ARKIT_SHAPES`, 0 for shapes that it lacks; None: the source sees no face
    head     yaw, pitch, roll in radians as in `Performance.head`; None where it holds none
    subject  the source's name for itself or its face
    time     seconds of the source's own clock; None where it sends none
    """

    names: tuple[str, ...]
    weights: np.ndarray | None
    head: tuple[float, float, float] | None = None
    subject: str = ""
    time: float | None = None
