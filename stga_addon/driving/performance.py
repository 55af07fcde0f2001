"""ARKit's 52 blend shapes, and face performances as their weights over time."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches

import numpy as np

from ..errors import StgaError, shorten

ARKIT_SHAPES = (
    "eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft",
    "eyeSquintLeft", "eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight",
    "eyeLookOutRight", "eyeLookUpRight", "eyeSquintRight", "eyeWideRight", "jawForward", "jawRight",
    "jawLeft", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthRight", "mouthLeft",
    "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft",
    "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight", "mouthRollLower", "mouthRollUpper",
    "mouthShrugLower", "mouthShrugUpper", "mouthPressLeft", "mouthPressRight", "mouthLowerDownLeft",
    "mouthLowerDownRight", "mouthUpperUpLeft", "mouthUpperUpRight", "browDownLeft", "browDownRight",
    "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff", "cheekSquintLeft",
    "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut",
)  # fmt: skip
"""ARKit's shapes, in the order of Live Link Face's CSV files."""
COUNT = len(ARKIT_SHAPES)
"""Number of ARKit's shapes, 52."""
MAX_WEIGHT = 10.0
"""Beyond it, weights of shapes are in percent, or are no weights."""
COLUMN = {name: column for column, name in enumerate(ARKIT_SHAPES)}
"""Shape -> its place in ARKIT_SHAPES."""
OPTIONAL = ("tongueOut",)
"""Shapes that sources of 51 lack; they stay zero."""
PARTS = ("face", "jaw", "eyes")
"""Parts of the face (`part_of`), each of which can be amplified."""
MAX_NAMED = 8
"""Names that an error lists."""

MIN_SIMILARITY = 0.8
"""Least similarity (`difflib`) of a mistyped name and the shape that it stands for."""
_KEYS = {name.lower(): name for name in ARKIT_SHAPES}
_LIKE_A_SHAPE = re.compile("(eye|jaw|mouth|brow|cheek|nose|tongue)(?!yaw|pitch|roll)")


def arkit_name(name: str) -> str | None:
    """ARKit's spelling of `blendShapes.JawOpen`, `mouth_smile_left`, `mouthSmile_L`: any capitals,
    separators and prefix up to the last dot; None where it is none of the 52."""
    plain = name.rsplit(".", 1)[-1].strip()
    side = re.fullmatch(r"(.*)[_\- ]([LR])", plain, re.IGNORECASE | re.DOTALL)
    if side:
        plain = side[1] + ("left" if side[2] in "lL" else "right")
    return _KEYS.get(re.sub(r"[_\- ]", "", plain).lower())


def part_of(name: str) -> str:
    """Which of `PARTS` an ARKit shape belongs to."""
    if name.startswith("jaw"):
        return "jaw"
    return "eyes" if name.startswith("eyeLook") else "face"


def mirrored_name(name: str) -> str:
    """The shape of the other side; shapes without a side are their own."""
    return re.sub("(Left|Right)$", lambda side: "Left" if side[0] == "Right" else "Right", name)


def columns_of(where: str, names: Iterable[str]) -> tuple[dict[int, int], list[str]]:
    """Column of the 52 -> first index in `names`; and a sentence where shapes are missing, but for
    those of `OPTIONAL`. Raises StgaError, beginning with `where`, without any shape, and where a
    name stands for a missing one that is mistyped."""
    listed = list(names)
    spelled = [arkit_name(name) for name in listed]
    found = {COLUMN[name]: spelled.index(name) for name in spelled if name is not None}
    missing = [name for name in ARKIT_SHAPES if COLUMN[name] not in found and name not in OPTIONAL]
    if not found:
        raise StgaError(f"{where}: names none of ARKit's {COUNT} blend shapes, such as jawOpen")
    if not missing:
        return found, []
    unknown = [name for name, known in zip(listed, spelled, strict=True) if known is None]
    strange = [name for name in unknown if _LIKE_A_SHAPE.match(_last(name).lower())]
    lowered = [name.lower() for name in missing]
    mistyped = [
        shorten(name)
        for name in strange
        if get_close_matches(_last(name).lower(), lowered, 1, MIN_SIMILARITY)
    ]
    more = f" and {len(missing) - MAX_NAMED} more" if len(missing) > MAX_NAMED else ""
    lacks = f"lacks {', '.join(missing[:MAX_NAMED])}{more}"
    if mistyped:
        raise StgaError(f"{where}: {lacks}; it has {', '.join(mistyped[:MAX_NAMED])}")
    strange = [f"{shorten(name)} is none of ARKit's" for name in strange[:MAX_NAMED]]
    return found, ["; ".join([f"{lacks}, which stay 0", *strange])]


def _last(name: str) -> str:
    return name.rsplit(".", 1)[-1]


MIRROR = np.array([COLUMN[mirrored_name(name)] for name in ARKIT_SHAPES])
EXCHANGEABLE = ("jaw", "mouth")  # Pairs, as mouthLeft and mouthRight, that some senders exchange
GAP = 1.5  # Rows farther apart than this many frames have lost some between them
SMOOTHING_REACH = 3.0  # Standard deviations of the smoothing kernel that are summed


@dataclass(frozen=True)
class Performance:
    """T rows of one take.

    times    (T,) seconds, ascending from 0; rows that were lost leave gaps
    weights  (T, 52) in the order of `ARKIT_SHAPES`, 0 to 1 at the source
    head     (T, 3) yaw, pitch, roll in radians; zero where the source has none, or None is given
    fps      rows per second where none is lost
    warnings  one sentence each: what was guessed
    guessed_fps  rate that frame numbers or rows without times were taken to count, as the last of
             the warnings says; None: the file has times
    """

    times: np.ndarray
    weights: np.ndarray
    head: np.ndarray
    fps: float
    warnings: tuple[str, ...] = ()
    guessed_fps: float | None = None

    def __post_init__(self) -> None:
        head = 0.0 if self.head is None else self.head
        object.__setattr__(self, "head", np.broadcast_to(head, (len(self.weights), 3)))

    @property
    def lost(self) -> int:
        """Number of rows that are missing between the first and the last."""
        steps = np.diff(self.times) * self.fps
        return int(np.round(steps[steps > GAP] - 1).sum())


def recorded_at(performance: Performance, fps: float) -> Performance:
    """The performance at this rate in place of the guessed one."""
    if performance.guessed_fps is None:
        return performance
    ratio = fps / performance.guessed_fps
    times = performance.times / ratio
    rate = performance.fps * ratio
    warnings = performance.warnings[:-1]
    return replace(performance, times=times, fps=rate, warnings=warnings, guessed_fps=None)


def resampled(performance: Performance, fps: float | None = None) -> Performance:
    """The performance at even times, `fps` a second (default: its own), interpolated linearly."""
    rate = performance.fps if fps is None else fps
    count = int(np.floor(performance.times[-1] * rate + 1e-6)) + 1
    times = np.arange(count) / rate

    def interpolated(values: np.ndarray) -> np.ndarray:
        columns = [np.interp(times, performance.times, column) for column in values.T]
        return np.stack(columns, axis=1)

    weights = interpolated(performance.weights)
    head = interpolated(performance.head)
    return replace(performance, times=times, weights=weights, head=head, fps=rate)


def mirrored(performance: Performance) -> Performance:
    """Left and right exchanged; the head's yaw and roll change their signs."""
    head = performance.head * [-1.0, 1.0, -1.0]
    return replace(performance, weights=performance.weights[:, MIRROR], head=head)


def exchanged_sides(performance: Performance, pairs: tuple[str, ...]) -> Performance:
    """jawLeft and jawRight exchanged, mouthLeft and mouthRight, or both (`EXCHANGEABLE`)."""
    weights = performance.weights.copy()
    for pair in pairs:
        left = COLUMN[f"{pair}Left"]
        right = COLUMN[f"{pair}Right"]
        weights[:, [left, right]] = weights[:, [right, left]]
    return replace(performance, weights=weights)


def smoothed(performance: Performance, seconds: float) -> Performance:
    """Convolved by a Gaussian of standard deviation `seconds`; rows must be even (`resampled`)."""
    deviation = seconds * performance.fps
    reach = int(np.ceil(SMOOTHING_REACH * deviation))
    if reach < 1:
        return performance
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    kernel /= kernel.sum()

    def convolved(values: np.ndarray) -> np.ndarray:
        padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
        return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)

    weights = convolved(performance.weights)
    head = convolved(performance.head)
    return replace(performance, weights=weights, head=head)


def amplified(performance: Performance, gains: Mapping[str, float]) -> Performance:
    """Weights times the gain of their part (PARTS, "head") or of their own name, else 1."""
    factors = np.array([gains.get(name, gains.get(part_of(name), 1.0)) for name in ARKIT_SHAPES])
    head = performance.head * gains.get("head", 1.0)
    return replace(performance, weights=performance.weights * factors, head=head)


def relative_to(performance: Performance, rest: Performance) -> Performance:
    """Without the face and head rotation of `rest` (its first row); a weight of 1 stays 1."""
    neutral = rest.weights[0]
    weights = (performance.weights - neutral) / np.maximum(1.0 - neutral, 0.1)
    return replace(performance, weights=weights, head=performance.head - rest.head[0])


@dataclass(frozen=True)
class FacePacket:
    """One frame of a live source.

    names    ARKit shapes that it holds
    weights  (52,) in the order of `ARKIT_SHAPES`, 0 for shapes that it lacks; None: the source sees
             no face
    head     yaw, pitch, roll in radians as in `Performance.head`; None where it holds none
    subject  the source's name for itself or its face
    time     seconds of the source's own clock; None where it sends none
    """

    names: tuple[str, ...]
    weights: np.ndarray | None
    head: tuple[float, float, float] | None = None
    subject: str = ""
    time: float | None = None
