"""SMPTE timecodes of Live Link Face's rows as seconds."""

import re

import numpy as np

from ..errors import StgaError, shorten

PATTERN = re.compile(r"(\d{1,3}):(\d{1,2}):(\d{1,2})([:;.])(\d{1,3})(?:\.(\d{1,6}))?", re.ASCII)
BASES = (24, 25, 30, 48, 50, 60, 100, 120)
"""Frames per second that timecodes count."""
USUAL_BASE = 60
"""Of a take of less than a second, whose frame numbers do not tell."""
DAY_S = 86_400.0
DROP_RATIO = 1000 / 1001
"""Timecodes with a semicolon leave out frame numbers, because their frames come this much slower."""


def seconds_of(where: str, texts: list[str]) -> np.ndarray:
    """(T,) seconds from the first of T timecodes `HH:MM:SS:FF.sub`, which may pass midnight.

    The rate that FF counts in is found from the numbers themselves: rows may come at half of it. Raises StgaError,
    which begins with `where` and names the row, for text that is no timecode.
    """
    fields = []
    for row, text in enumerate(texts):
        found = PATTERN.fullmatch(text.strip())
        if found is None:
            raise StgaError(f"{where}: row {row + 1}: Timecode is {shorten(text)}, expected HH:MM:SS:FF.sub")
        hours, minutes, whole = (int(found[group]) for group in (1, 2, 3))
        fields.append((hours, minutes, whole, int(found[5]), float(f"0.{found[6] or 0}"), found[4] == ";"))
    hours, minutes, whole, frames, parts, dropping = np.array(fields, np.float64).T
    second = 3600 * hours + 60 * minutes + whole
    base = _base(second, frames + parts)
    if dropping.any():
        total_minutes = 60 * hours + minutes
        counted = second * base + frames + parts - round(base / 15) * (total_minutes - np.floor(total_minutes / 10))
        elapsed = counted / (base * DROP_RATIO)
    else:
        elapsed = second + (frames + parts) / base
    days = np.concatenate([[0], np.cumsum(np.diff(elapsed) < -DAY_S / 2)])
    return np.asarray(elapsed + DAY_S * days - elapsed[0])


def _base(second: np.ndarray, frames: np.ndarray) -> int:
    """The frame rate for which the rows come most evenly."""
    possible = [base for base in BASES if base > frames.max()] or [int(frames.max()) + 1]
    if len(np.unique(second)) < 2:
        return USUAL_BASE if USUAL_BASE in possible else possible[0]
    return min(possible, key=lambda base: (_unevenness(second + frames / base), base))


def _unevenness(times: np.ndarray) -> float:
    steps = np.diff(times)
    steps = steps[(steps > 0) & (steps < 1)]
    return round(float(np.abs(steps - np.median(steps)).mean()), 6) if len(steps) else 0.0
