"""When the rows of a recording are: timecodes, and numbers of seconds, their parts, or frames."""

import re
from collections.abc import Iterable

import numpy as np

from ..errors import StgaError, shorten

TIMECODE = re.compile(
    r"(?:\d{4}-\d\d-\d\d[T ])?(\d{1,3}):(\d{1,2}):(\d{1,2})"
    r"(?:([:;.,])(\d{1,9})(?:[.,](\d{1,6}))?)?(?:Z|[+-]\d\d:?\d\d)?",
    re.ASCII,
)
"""Also of a date in ISO 8601."""
BASES = (24, 25, 30, 48, 50, 60, 100, 120)  # Frames per second that timecodes count
USUAL_BASE = 60  # Of a take of less than a second, whose frame numbers do not tell
DAY_S = 86_400.0
DROP_RATIO = 1000 / 1001  # Of drop-frame timecodes, with a semicolon, whose frames come slower
CLOCK_TOLERANCE_S = 0.002  # Of milliseconds that are cut off or rounded
MIN_DISTINCT_FRAMES = 3  # Frames of a second that tell milliseconds from shares of a frame
UNITS_S = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "micros", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanosecond", "nanoseconds"), 1e-9),
}
UNIT_NAMES = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
TIME_WORDS = ("timecode", "time", "timestamp", "elapsed", "t", "pts")
"""Names of times, in the order in which one of several is taken."""
BESIDE_TIMES = ("frame", "stamp", "code", "in", "relative", "media", "video")
MIN_ROWS_PER_S = 1.5
MAX_ROWS_PER_S = 250.0
"""Of recordings of faces; of seconds and their thousandths, only one gives such a rate."""
MAX_FRAME_STEP = 4  # Between rows that are numbered by frames of `DEFAULT_FPS`
DEFAULT_FPS = 60.0  # Of files that hold neither times nor a rate: ARKit's own
RATES = tuple(sorted({rate * share for rate in (10, 12, 15, *BASES) for share in (1, DROP_RATIO)}))
MAX_RATE_DIFFERENCE = 0.02  # Of a usual rate from that of the times, relative
GRID_TOLERANCE = 0.1  # Of a row's distance, within which all rows come evenly
LONG_STEP = 1.5  # Times the median, above which rows are missing between two


def time_column(names: Iterable[str]) -> tuple[int, float | None] | None:
    """Place and unit (seconds; None: not said) of the column that says when rows are; None where
    there is none. One that says its unit is taken first."""
    found = []
    for place, name in enumerate(names):
        words = _words(name)
        unit = next((UNITS_S[word] for word in words if word in UNITS_S and word != "s"), None)
        if unit is None and len(words) > 1 and words[-1] == "s":
            unit = UNITS_S["s"]
        rank = next((rank for rank, word in enumerate(TIME_WORDS) if word in words), None)
        others = [w for w in words if w not in UNITS_S and w not in TIME_WORDS + BESIDE_TIMES]
        if not others and (unit is not None or rank is not None):
            found.append((unit is None, len(TIME_WORDS) if rank is None else rank, place, unit))
    if not found:
        return None
    _, _, place, unit = min(found, key=lambda each: each[:3])
    return place, unit


def _words(name: str) -> list[str]:
    """Words of a heading such as timestampMs, time (ms) or blendShapes.timeCode."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name.rsplit(".", 1)[-1])
    words = re.findall(r"[^\W\d_]+", apart.lower())
    return re.sub(r"\btime code\b", "timecode", " ".join(words)).split()


def seconds_of_numbers(
    column: str, values: np.ndarray, unit: float | None, fps: float | None = None
) -> tuple[np.ndarray, str | None]:
    """(T,) seconds of a column of numbers, and a sentence where its unit is guessed: it is the one
    that gives a plausible rate. Small whole numbers are of frames, `fps` a second."""
    steps = np.diff(np.unique(values[np.isfinite(values)]))
    if unit is not None or not len(steps):
        return values * (unit or 1.0), None
    step = float(np.median(steps))
    for unit in (1.0, *UNIT_NAMES):
        if 1 / MAX_ROWS_PER_S <= step * unit <= 1 / MIN_ROWS_PER_S:
            guess = f"{column} holds {UNIT_NAMES.get(unit)}, by its steps of {step:g}"
            return values * unit, guess if unit in UNIT_NAMES else None
    if step <= MAX_FRAME_STEP and np.isfinite(values).all() and (values % 1 == 0).all():
        rate = fps or DEFAULT_FPS
        counts = f"{column} counts frames; they are taken as {rate:g} a second"
        return values / rate, counts
    return values, None


def seconds_of(where: str, texts: list[str]) -> np.ndarray:
    """(T,) seconds from the first of timecodes `HH:MM:SS:FF.sub`, over midnight too; the rate of FF
    is found from the numbers. A fraction behind a point is of the second where it has three digits
    or more, or where that of all rows agrees with FF. Raises StgaError, beginning with `where`, for
    other text."""
    fields = []
    decimals = []
    for row, text in enumerate(texts):
        found = TIMECODE.fullmatch(text.strip())
        if found is None:
            raise StgaError(
                f"{where}: row {row + 1}: Timecode is {shorten(text)}, expected HH:MM:SS:FF.sub"
            )
        hours, minutes, whole, separator, frame, part = found.groups()
        clock = int(hours), int(minutes), int(whole)
        fields.append((*clock, int(frame or 0), float(f"0.{part or 0}"), separator == ";"))
        decimals.append(frame or "0" if part is None and separator in (".", ",", None) else None)
    hours, minutes, whole, frames, parts, dropping = np.array(fields, np.float64).T
    second = 3600 * hours + 60 * minutes + whole
    digits = [text for text in decimals if text is not None]
    if len(digits) == len(decimals) and max(map(len, digits)) >= 3:
        elapsed = second + np.array([float(f"0.{text}") for text in digits])
    elif _are_of_clock(frames, parts):
        elapsed = second + parts
    else:
        elapsed = _seconds_of_frames(second, frames, parts, bool(dropping.any()))
    days = np.concatenate([[0], np.cumsum(np.diff(elapsed) < -DAY_S / 2)])
    return elapsed + DAY_S * days - elapsed[0]


def _are_of_clock(frames: np.ndarray, parts: np.ndarray) -> bool:
    """Whether the parts behind frame numbers are of the second, which they then repeat, as
    NeuroSync writes them."""
    if len(np.unique(frames)) < MIN_DISTINCT_FRAMES:
        return False
    early = -CLOCK_TOLERANCE_S
    late = CLOCK_TOLERANCE_S
    within = [(parts - frames / base, 1 / base) for base in BASES if base > frames.max()]
    return any(((off > early) & (off < length + late)).all() for off, length in within)


def _seconds_of_frames(
    second: np.ndarray, frames: np.ndarray, parts: np.ndarray, is_dropping: bool
) -> np.ndarray:
    """Seconds of frame numbers, at the frame rate for which the rows come most evenly."""
    possible = [base for base in BASES if base > (frames + parts).max()] or [int(frames.max()) + 1]
    base = USUAL_BASE if USUAL_BASE in possible else possible[0]
    if len(np.unique(second)) > 1:
        base = min(possible, key=lambda base: _unevenness(second + (frames + parts) / base))
    if not is_dropping:
        return second + (frames + parts) / base
    minute = second // 60
    left_out = round(base / 15) * (minute - np.floor(minute / 10))
    return (second * base + frames + parts - left_out) / (base * DROP_RATIO)


def _unevenness(times: np.ndarray) -> float:
    steps = np.diff(times)
    steps = steps[(steps > 0) & (steps < 1)]
    return round(float(np.abs(steps - np.median(steps)).mean()), 6) if len(steps) else 0.0


def evened(times: np.ndarray) -> tuple[np.ndarray, float]:
    """Ascending times (T,) from 0, and how many rows a second there are where none is missing.

    Where rows come evenly but for rounding, as whole milliseconds are, times are those of even
    rows, at a usual rate where that agrees as well.
    """
    if len(times) < 2:
        return times, DEFAULT_FPS
    steps = np.diff(times)
    usual = steps[steps <= LONG_STEP * np.median(steps)]
    mean = 1 / float(usual.mean())
    near = [rate for rate in RATES if abs(rate / mean - 1) < MAX_RATE_DIFFERENCE]
    for rate in (*sorted(near, key=lambda own: abs(own - mean)), mean):
        rows = np.round(times * rate)
        if (np.diff(rows) > 0).all() and np.abs(times * rate - rows).max() < GRID_TOLERANCE:
            return rows / rate, rate
    return times, 1 / float(np.median(steps))
