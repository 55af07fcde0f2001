"""Times of a recording's rows: timecodes, or numbers of seconds, their parts or frames."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from unicodedata import normalize

import numpy as np

from ..errors import StgaError, shorten

TIMECODE = re.compile(
    r"(?:\d{1,4}[-/.]\d\d?[-/.]\d{1,4}(?:T|,? ))?(?:(\d{1,3}):)?(\d{1,2}):(\d{1,2})"
    r"(?:([:;.,])(\d{1,9})(?:[.,](\d{1,6}))?)?"
    r"(?: ?([AP])\.?M\.?)?(?: ?(?:Z|UTC|GMT|[+-]\d\d:?\d\d))?",
    re.ASCII | re.IGNORECASE,
)
"""Also behind a date, as in ISO 8601, and before AM or PM; hours may be missing."""
Columns = Mapping[str, Sequence[object]]
"""Columns of a table by their names."""
BASES = (24, 25, 30, 48, 50, 60, 100, 120, 240)
"""Frames per second that timecodes count."""
TYPICAL_BASE = 60
"""Base of a take whose frame numbers do not determine it, as within one second."""
EVEN_TOLERANCE_S = 1e-6
"""Difference of unevenness within which bases explain the frame numbers equally well."""
OTHER_RATE = "--recorded-fps, in Blender Recorded At, sets another rate"
"""End of a message about a guessed rate."""
DAY_S = 86_400.0
"""Seconds after which clocks begin again at zero."""

DROP_DAY_S = (30 * DAY_S - 2 * 1296) * 1001 / 30_000
"""A day in which 1296 minutes leave out two of 30 frames a second."""
DROP_RATIO = 1000 / 1001
"""Speed of drop-frame timecodes, with a semicolon, whose frames come slower."""
CLOCK_TOLERANCE_S = 0.002
"""Error of milliseconds that are cut off or rounded."""
MIN_DISTINCT_FRAMES = 3
"""Frames of a second that distinguish milliseconds from fractions of a frame."""
UNITS_S = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "μs", "usec", "micros", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanosecond", "nanoseconds"), 1e-9),
    **dict.fromkeys(("tick", "ticks"), 1e-7),  # of .NET and Unreal Engine
    **dict.fromkeys(("min", "mins", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), 3600.0),
    **dict.fromkeys(("day", "days"), 86_400.0),
}
"""Units as NFKC spells them, which makes the micro sign a Greek letter -> seconds."""
LETTER_UNITS = ("s", "h")
"""Units that name one only at the end of a heading of several words."""
UNIT_NAMES = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
"""Seconds of a unit -> its name in messages."""
CALENDARS = {
    "milliseconds since 1970": (1e-3, 1970),
    "microseconds since 1970": (1e-6, 1970),
    "nanoseconds since 1970": (1e-9, 1970),
    "ticks of Windows since 1601": (1e-7, 1601),
    "ticks of .NET since the year 1": (1e-7, 1),
    "days since 1900": (86_400.0, 1900),
}
"""What a column holds -> seconds of its unit, and the year that it counts from."""
YEAR_S = 31_556_952.0
"""Mean year of the calendar."""
RECORDED_YEARS = (1995, 2100)
"""Years in which a number that counts from a calendar's beginning may lie."""
TIME_WORDS = (
    *("timecode", "time", "timestamp", "elapsed", "t", "pts"),
    *("ts", "clock", "datetime", "date", "epoch", "unix", "utc"),
)
"""Names of times, in the order in which one of several is taken."""
BESIDE_TIMES = ("frame", "stamp", "code", "in", "relative", "media", "video")
"""Words that may stand beside these in a column's name."""
MIN_FPS = 1.0
"""Least rows a second of a performance."""
MAX_FPS = 1000.0
"""Most rows a second of a performance."""
MIN_ASCENDING = 0.9
"""Fraction of the steps of a column of times that do not descend."""
MIN_DISTINCT = 0.5
"""Fraction of the values of a column of times that differ from all before."""
MAX_DIFFERENCE = 0.05
"""Relative difference of two columns' durations, above which they disagree."""
MIN_ROWS_PER_S = 5.0
"""Least rows a second that recordings of faces have: of seconds and their thousandths, only one
gives such a rate."""
MAX_ROWS_PER_S = 250.0
"""Most rows a second that they have."""
MIN_UNNAMED_ROWS = 10
"""Rows from which a column that is not called a time, and ascends as one, is taken for times."""

MAX_FRAME_STEP = 4
"""Largest step between rows that are numbered by frames of `DEFAULT_FPS`."""
MAX_NUMBER = 1e300
"""Number of a column from which differences overflow."""
MAX_SECONDS = 1e12
"""Largest time: clocks count from 1970, or from the year 1."""

DEFAULT_FPS = 60.0
"""Frame rate of files with neither times nor a rate: ARKit's."""
RATES = tuple(sorted({rate * ratio for rate in (10, 12, 15, *BASES) for ratio in (1, DROP_RATIO)}))
"""Standard frame rates per second, each also at the speed of drop-frame timecodes."""

MAX_RATE_DIFFERENCE = 0.02
"""Largest relative difference between a standard rate and that of the times."""
GRID_TOLERANCE = 0.1  # Largest deviation, in distances of rows, with which all rows come evenly
LONG_STEP = 1.5  # Multiple of the median step, above which rows are missing between two


@dataclass(frozen=True)
class _Column:
    """A column that is called a time.

    unit       seconds; None: not said
    is_plain   whether its name says nothing else, as device_time does
    rank       of its word in `TIME_WORDS`
    """

    name: str
    unit: float | None
    is_plain: bool
    rank: int


@dataclass(frozen=True)
class Guess:
    """A sentence about what was guessed of times.

    fps  rate that frame numbers were taken to count; None: their unit was guessed
    """

    text: str
    fps: float | None = None


def find_times(
    where: str, columns: Columns, fps: float | None
) -> tuple[np.ndarray | None, list[str], Guess | None]:
    """(T,) seconds of rows, None where nothing says them; a sentence each for columns of times that
    are not used; and what was guessed of the used one.

    columns  name -> texts or numbers (T,) of what is no shape. Used is the first that ascends at a
             plausible rate; names with a unit and without other words go first, names that are
             not of times are used where there is no rate either (`_times_by_contents`)
    fps      rate at which whole numbers count frames; None: `DEFAULT_FPS`
    Raises StgaError, beginning with `where`, where none is used and a plain one cannot be read.
    """
    used = None
    guess = None
    notes = []
    left_out = []
    error = None
    for column in _time_columns(columns):
        try:
            times, guessed = _seconds(where, column, columns[column.name], fps)
        except StgaError as unreadable:
            error = error or (unreadable if column.is_plain else None)
            detail = str(unreadable).removeprefix(f"{where}: ")
            left_out.append(f"{column.name} is not readable ({detail})")
            continue
        problem = _implausible(times)
        if problem:
            left_out.append(f"{column.name} {problem}")
        elif used is None:
            used = times
            name = column.name
            guess = guessed
        elif abs(np.ptp(times) / np.ptp(used) - 1) > MAX_DIFFERENCE:
            seconds = f"{np.ptp(times):.4g} s, not {np.ptp(used):.4g}"
            notes.append(f"column {column.name} lasts {seconds}; it is not used, {name} is")
    if used is not None:
        notes += [f"column {text}; {name} is used" for text in left_out]
        return used, notes, guess
    if error is not None:
        raise error
    if not left_out and fps is None:
        used, guess, left_out = _times_by_contents(where, columns)
    if used is not None:
        return used, [], guess
    return None, [f"column {'; column '.join(left_out)}"] if left_out else [], None


def _time_columns(columns: Columns) -> list[_Column]:
    """Those that are called a time and are not empty, the likeliest first."""
    found = []
    for name, cells in columns.items():
        words = _words(name)
        named = [word for word in words if word in UNITS_S and word not in LETTER_UNITS]
        if not named and len(words) > 1 and words[-1] in LETTER_UNITS:
            named = words[-1:]
        unit = UNITS_S[named[0]] if named else None
        rank = next((rank for rank, word in enumerate(TIME_WORDS) if word in words), None)
        others = [w for w in words if w not in UNITS_S and w not in TIME_WORDS + BESIDE_TIMES]
        has_cells = any(cell not in (None, "") for cell in cells)
        if has_cells and (unit is not None or rank is not None):
            place = len(TIME_WORDS) if rank is None else rank
            found.append(_Column(name, unit, not others, place))
    return sorted(found, key=lambda each: (not each.is_plain, each.unit is None, each.rank))


def _times_by_contents(
    where: str, columns: Columns
) -> tuple[np.ndarray | None, Guess | None, list[str]]:
    """(T,) seconds of the first column of timecodes, or of numbers that ascend as times do, as
    names in other languages leave it; and what was guessed. Else a sentence each for columns that
    ascend otherwise, as numbers of frames do."""
    left_out = []
    for name, cells in columns.items():
        try:
            is_of_codes = all(":" in str(cell) for cell in cells)
            steps = np.zeros(0) if is_of_codes else np.diff(numbers(where, name, cells))
            times, guess = _seconds(where, _Column(name, None, False, 0), cells, None)
        except StgaError:
            continue
        if not is_of_codes and not (len(steps) and (steps > 0).all()):
            continue
        is_rate = guess is not None and guess.fps is not None
        is_clear = is_of_codes or (len(cells) >= MIN_UNNAMED_ROWS and not is_rate)
        if is_clear and not _implausible(times):
            text = guess.text if guess else f"column {name} is taken as seconds"
            taken = f"{text}, though it is not called a time"
            return times, replace(guess, text=taken) if guess else Guess(taken), []
        left_out.append(f"{name} ascends, but is not called a time")
    return None, None, left_out


def _words(name: str) -> list[str]:
    """Words of a heading such as timestampMs, unixtime, time (ms) or blendShapes.timeCode."""
    text = normalize("NFKC", re.split(r"\.(?=\w)", name)[-1])
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text).lower()
    apart = re.sub(r"(timestamp|timecode|datetime|time)", r" \1 ", apart)
    words = re.findall(r"[^\W\d_]+", apart)
    return re.sub(r"\btime code\b", "timecode", " ".join(words)).split()


def _seconds(
    where: str, column: _Column, cells: Sequence[object], fps: float | None
) -> tuple[np.ndarray, Guess | None]:
    """(T,) seconds of a column's timecodes or numbers, and what was guessed."""
    if any(":" in str(cell) for cell in cells):
        times, base = seconds_of(where, [str(cell) for cell in cells], fps)
        if base is None:
            return times, None
        why = "timecodes do not show how many frames a second has"
        taken = f"they are taken as {base:g} a second"
        return times, Guess(f"column {column.name}: {why}; {taken}; {OTHER_RATE}", base)
    values = numbers(where, column.name, cells)
    return seconds_of_numbers(f"column {column.name}", values, column.unit, fps)


def numbers(where: str, name: str, cells: Sequence[object]) -> np.ndarray:
    """(T,) of a column. Raises StgaError naming the row for what is no number."""
    found = np.empty(len(cells))
    for row, cell in enumerate(cells):
        try:
            if isinstance(cell, bool) or not isinstance(cell, (str, int, float)):
                raise ValueError
            found[row] = float(cell)
        except (ValueError, OverflowError):
            raise StgaError(
                f"{where}: row {row + 1}: {shorten(name)} is {shorten(cell)}, expected a number"
            ) from None
    return found


def _implausible(times: np.ndarray) -> str:
    """Why these are no times of rows, or ""."""
    if not np.isfinite(times).all():
        return "is not finite"
    if len(times) < 2:
        return ""
    distinct = np.unique(times)
    if np.abs(distinct).max() > MAX_SECONDS:
        return f"reaches {np.abs(distinct).max():.3g} s"
    if len(distinct) <= MIN_DISTINCT * len(times):
        return "repeats its values"
    rate = 1 / float(np.median(np.diff(distinct)))
    if not MIN_FPS <= rate <= MAX_FPS:
        return f"has {rate:.3g} rows a second"
    steps = np.diff(distinct)
    is_even = steps.max() < LONG_STEP * steps.min()  # rows in another order
    if np.mean(np.diff(times) >= 0) < MIN_ASCENDING and not is_even:
        return "does not ascend"
    return ""


def seconds_of_numbers(
    column: str, values: np.ndarray, unit: float | None, fps: float | None
) -> tuple[np.ndarray, Guess | None]:
    """(T,) seconds of a column of numbers, and a sentence where its unit is guessed: it is the one
    that gives a plausible rate. Small whole numbers are of frames, `fps` a second."""
    steps = np.diff(np.unique(values[np.abs(values) < MAX_NUMBER]))
    if unit is not None or not len(steps):
        return values * (unit or 1.0), None
    step = float(np.median(steps))
    for name, (unit, year) in CALENDARS.items():
        since, until = (YEAR_S * (each - year) / unit for each in RECORDED_YEARS)
        if _is_of_rows(step * unit) and ((values > since) & (values < until)).all():
            return values * unit, Guess(f"{column} holds {name}, by its size and its steps")
    for unit in (1.0, *UNIT_NAMES):
        if _is_of_rows(step * unit):
            guess = f"{column} holds {UNIT_NAMES.get(unit)}, by its steps of {step:g}"
            return values * unit, Guess(guess) if unit in UNIT_NAMES else None
    if step <= MAX_FRAME_STEP and np.isfinite(values).all() and (values % 1 == 0).all():
        rate = fps or DEFAULT_FPS
        counts = f"{column} counts frames; they are taken as {rate:g} a second"
        return values / rate, Guess(counts) if fps else Guess(f"{counts}; {OTHER_RATE}", rate)
    return values, None


def _is_of_rows(step_s: float) -> bool:
    """Whether recordings of faces have rows so far apart."""
    return 1 / MAX_ROWS_PER_S <= step_s <= 1 / MIN_ROWS_PER_S


def seconds_of(where: str, texts: list[str], fps: float | None) -> tuple[np.ndarray, float | None]:
    """(T,) seconds from the first of timecodes `HH:MM:SS:FF.sub`, over midnight too; the rate of FF
    is found from the numbers, and returned where these do not determine it and `fps` is not given.
    A fraction behind a point is of the second where it has three digits or more, or where that of
    all rows agrees with FF; so are thousandths behind a colon. Raises StgaError, beginning with
    `where`, for other text."""
    fields = []
    digits = []
    marks = set()
    for row, text in enumerate(texts):
        found = TIMECODE.fullmatch(" ".join(text.split()))
        if found is None:
            raise StgaError(
                f"{where}: row {row + 1}: Timecode is {shorten(text)}, expected HH:MM:SS:FF.sub"
            )
        hours, minutes, whole, mark, frame, part, half = found.groups()
        hour = int(hours or 0)
        if half:  # 12:05 AM is five past midnight
            hour = hour % 12 + (12 if half in "pP" else 0)
        clock = hour, int(minutes), int(whole)
        fields.append((*clock, int(frame or 0), float(f"0.{part or 0}")))
        marks.add(mark)
        if part is None:
            digits.append(frame or "0")
    hours, minutes, whole, frames, parts = np.array(fields, np.float64).T
    second = 3600 * hours + 60 * minutes + whole
    fraction = None
    if len(digits) == len(fields):
        fraction = _fractions(second, digits, marks <= {".", ",", None})
    if fraction is None and _are_of_clock(frames, parts):
        fraction = parts
    day = DAY_S
    guess = None
    if fraction is not None:
        elapsed = second + fraction
    else:
        day = DROP_DAY_S if ";" in marks else DAY_S
        base, is_known = _base_of(second, frames + parts, fps)
        guess = None if is_known else base
        elapsed = _seconds_of_frames(second, frames + parts, base, ";" in marks)
    return elapsed + day * _days(elapsed) - elapsed[0], guess


def _days(times: np.ndarray) -> np.ndarray:
    """How often midnight has passed in each row."""
    return np.concatenate([[0], np.cumsum(np.diff(times) < -DAY_S / 2)])


def _fractions(second: np.ndarray, digits: list[str], is_decimal: bool) -> np.ndarray | None:
    """(T,) parts of a second that the digits behind it are; None where they count frames.

    is_decimal: whether they stand behind a point or a comma. Thousandths without leading zeros, 33
    for 033, are known by times that else descend.
    """
    longest = max(map(len, digits))
    if longest < 3:
        return None
    values = np.array([int(text) for text in digits], np.float64)
    steps = np.diff(values)[np.diff(second) == 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    is_short = step <= MAX_FRAME_STEP or len(np.unique(second)) > 2
    if not is_decimal and values.max() < BASES[-1] and is_short:
        return None
    fraction = np.array([float(f"0.{text}") for text in digits])
    if longest > 3 or _descents(second + fraction) <= _descents(second + values / 1000):
        return fraction
    return values / 1000


def _descents(times: np.ndarray) -> int:
    return int((np.diff(times) < 0).sum())


def _are_of_clock(frames: np.ndarray, parts: np.ndarray) -> bool:
    """Whether the parts behind frame numbers are of the second, which they then repeat, as
    NeuroSync writes them."""
    if len(np.unique(frames)) < MIN_DISTINCT_FRAMES:
        return False
    early = -CLOCK_TOLERANCE_S
    late = CLOCK_TOLERANCE_S
    within = [(parts - frames / base, 1 / base) for base in BASES if base > frames.max()]
    return any(((off > early) & (off < length + late)).all() for off, length in within)


def _base_of(second: np.ndarray, frames: np.ndarray, fps: float | None) -> tuple[int, bool]:
    """The frames a second for which rows come most evenly, and whether that or `fps` determines it,
    or it makes no difference."""
    bases = [base for base in BASES if base > frames.max()] or [10 ** len(str(int(frames.max())))]
    if len(np.unique(second)) > 1:
        second = second + DAY_S * _days(second)
        off = {base: _unevenness(second + frames / base) for base in bases}
        bases = [base for base in bases if off[base] <= min(off.values()) + EVEN_TOLERANCE_S]
    if fps is not None and round(fps) in bases:
        return round(fps), True
    base = TYPICAL_BASE if TYPICAL_BASE in bases else bases[0]
    return base, len(bases) == 1 or not np.ptp(frames)


def _seconds_of_frames(
    second: np.ndarray, frames: np.ndarray, base: int, is_dropping: bool
) -> np.ndarray:
    """Seconds of frame numbers with their parts, `base` a second."""
    if not is_dropping:
        return second + frames / base
    minute = second // 60
    left_out = round(base / 15) * (minute - np.floor(minute / 10))
    return (second * base + frames - left_out) / (base * DROP_RATIO)


def _unevenness(times: np.ndarray) -> float:
    steps = np.diff(times)
    steps = steps[(steps > 0) & (steps < 1)]
    return round(float(np.abs(steps - np.median(steps)).mean()), 6) if len(steps) else 0.0


def at_even_times(times: np.ndarray) -> tuple[np.ndarray, float]:
    """Times (T,) in seconds, ascending from 0, and the rate in rows a second, gaps ignored.

    Rows that are even but for rounding, as to milliseconds, get even times, at a standard rate if
    that fits.
    """
    if len(times) < 2:
        return times, DEFAULT_FPS
    steps = np.diff(times)
    typical = steps[steps <= LONG_STEP * np.median(steps)]
    mean = 1 / float(typical.mean())
    near = [rate for rate in RATES if abs(rate / mean - 1) < MAX_RATE_DIFFERENCE]
    for rate in (*sorted(near, key=lambda standard: abs(standard - mean)), mean):
        rows = np.round(times * rate)
        if (np.diff(rows) > 0).all() and np.abs(times * rate - rows).max() < GRID_TOLERANCE:
            return rows / rate, rate
    return times, 1 / float(np.median(steps))
