"""Camera paths of videos: an orbit around a head, as far as its cameras saw it."""

from collections.abc import Sequence

import numpy as np

from .camera import Camera, azimuths, orbited

TURNTABLE_S = 6.0
"""Duration of a turntable, unless the motion is longer."""
UP = (0.0, 1.0, 0.0)
"""Captures are y-up."""
MAX_GAP_RAD = np.radians(100)
"""Radians without a camera from which on a side counts as unseen."""


def turntable(
    start: Camera, center: np.ndarray, count: int, angles: tuple[float, float], up: Sequence[float] = UP
) -> list[Camera]:
    """`count` cameras that orbit the vertical axis through `center` (3,), from where `start` is.

    angles: radians from `start`, from `covered_angles`; a full turn goes around once, less swings to both sides.
    """
    low, high = angles
    shares = np.arange(count) / count
    if high - low >= 2 * np.pi:
        turns = 2 * np.pi * shares
    else:
        turns = (low + high) / 2 + (high - low) / 2 * np.sin(2 * np.pi * shares)
    return [orbited(start, center, up, turn) for turn in turns]


def covered_angles(
    cameras: Sequence[Camera], start: Camera, center: np.ndarray, up: Sequence[float] = UP
) -> tuple[float, float]:
    """The angles about the vertical axis through `center` (3,), in radians from `start`, that the cameras cover.

    Of what no camera saw, training has nothing to show. A full turn where they leave no gap of MAX_GAP_RAD.
    """
    seen = np.sort(np.append(azimuths(cameras, start, center, up), 0.0))
    gaps = np.diff(np.append(seen, seen[0] + 2 * np.pi))
    if gaps.max() < MAX_GAP_RAD:
        return -np.pi, np.pi
    widest = int(gaps.argmax())
    low, high = seen[(widest + 1) % len(seen)], seen[widest]
    return (low - 2 * np.pi if low > 0 else low), (high + 2 * np.pi if high < 0 else high)


def to_and_fro(timesteps: Sequence[int], count: int) -> list[int]:
    """`count` timesteps that play a motion forward and back, as often as it fits."""
    there_and_back = [*timesteps, *timesteps[-2:0:-1]]
    return [there_and_back[index % len(there_and_back)] for index in range(count)]
