"""Progress of work, whatever it is, and how it is reported and cancelled."""

import logging
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

import numpy as np

Item = TypeVar("Item")
"""Type of the items whose iteration is reported."""
PACE_FRACTION = 0.1
"""Fraction of the work, the last that was done, whose pace gives the time that is left."""
MAX_OVERRUN_RATIO = 1.25
"""Ratio of the time that the work took to its forecast, above which the forecast was too short."""
MIN_FALL = 0.1
"""Seconds by which the time left falls each second, where the work reports no time left."""
MIN_LEFT_S = 1.0
"""Time left of work that takes longer than was forecast."""
MIN_PACE_S = 5.0
"""Time for which the work's forecast is watched before it is corrected."""
MAX_STEP_FRACTION = 0.05
"""Largest fraction of a step; beyond it, an interrupted call had done the work before."""


@dataclass(frozen=True)
class Progress:
    """How far the work is.

    fraction  0 to 1
    stage     what is being done; detail: more about it
    figures   gives named numbers that depend on the kind of work, NaN where one is not known yet
    preview   writes the result so far into a file; None before there is one
    picture   draws the result so far: `rgb` (H, W, 3) uint8, of a head `vertices` (V, 3) and
              `faces` (F, 3) too; or nothing. None where nothing new is to be seen
    metrics   of a training: its evaluations so far, the lines of metrics.jsonl
    """

    fraction: float = 0.0
    stage: str = ""
    detail: str = ""
    figures: Callable[[], Mapping[str, float]] = dict
    preview: Callable[[Path], None] | None = None
    picture: Callable[[], Mapping[str, np.ndarray] | None] | None = None
    metrics: Sequence[Mapping[str, Any]] = ()


Report = Callable[[Progress], bool]
"""Called now and then; returns True to stop and keep what there is."""
Log = Callable[[str], None]  # Called with a line for people


def warn(sentence: str) -> None:
    """Log a repair where nobody else listens."""
    logging.getLogger(__name__).warning("warning: %s", sentence)


@dataclass(frozen=True)
class Written:
    """Result of work: a file or a folder. lines: sentences about it."""

    path: Path
    lines: tuple[str, ...] = ()


class TimeLeft:
    """Seconds that are left of work, as its fraction grows."""

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        self._last = clock(), 0.0
        # Seconds and fractions of the steps that determine the pace
        self._steps: deque[tuple[float, float]] = deque()

    def after(self, fraction: float) -> float:
        """Once `fraction` of the work is done; NaN where the pace is not known yet."""
        now = self._clock()
        (before, begun) = self._last
        self._last = now, fraction
        if 0 <= fraction - begun <= MAX_STEP_FRACTION:
            self._steps.append((now - before, fraction - begun))
        seconds, done = map(sum, zip(*self._steps, strict=True)) if self._steps else (0.0, 0.0)
        while done > PACE_FRACTION and done - self._steps[0][1] >= PACE_FRACTION:
            first = self._steps.popleft()
            seconds = seconds - first[0]
            done = done - first[1]
        return (1 - fraction) * seconds / done if done >= PACE_FRACTION / 10 else math.nan


MAX_REPORTED_FRACTION = 0.99
"""Largest fraction that is reported before the end: 100 % means finished work."""


class Clock:
    """How far work is and how long it takes, as it is reported: neither ever goes back."""

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self.fraction = 0.0
        self._clock = clock
        self._by_fraction = TimeLeft(clock)
        self._left_s = math.inf
        self._reported_s = clock()
        # When work lately reported how many seconds are left, and how many
        self._asked: deque[tuple[float, float]] = deque()

    def reported(self, progress: Progress) -> dict[str, float]:
        """The finite figures of some progress; `left_s`, by the fraction where the work does not
        say, else as before, always falls, more slowly where it was too little, and `longer` is 1
        where it is, or the work knows it to be."""
        self.fraction = max(self.fraction, min(progress.fraction, MAX_REPORTED_FRACTION))
        figures = {"left_s": self._by_fraction.after(progress.fraction), **progress.figures()}
        figures = {name: value for name, value in figures.items() if math.isfinite(value)}
        asked_s = figures.get("left_s", self._left_s)
        if math.isfinite(asked_s):
            expected_s = self._expected_s(asked_s)
            self._left_s = min(self._fallen_s(expected_s), expected_s)
            figures["left_s"] = self._left_s
            if expected_s > MAX_OVERRUN_RATIO * self._left_s + 1:
                figures["longer"] = 1.0
        return figures

    def _fallen_s(self, expected_s: float) -> float:
        """What was left when it was last reported, less what fits to reach 0 when it is expected
        to: a number that stands still looks like work that does."""
        silent_s = self._clock() - self._reported_s
        self._reported_s += silent_s
        if not math.isfinite(self._left_s):
            return self._left_s
        fall = min(1.0, self._left_s / expected_s) if expected_s > 0 else 1.0
        return _fallen_s(self._left_s, max(MIN_FALL, fall) * silent_s)

    def _expected_s(self, asked_s: float) -> float:
        """What is left where it goes on to fall as slowly as it lately did."""
        now = self._clock()
        self._asked.append((now, asked_s))
        while len(self._asked) > 2 and now - self._asked[1][0] >= max(2 * MIN_PACE_S, asked_s / 2):
            self._asked.popleft()
        (then, before) = self._asked[0]
        if now - then < MIN_PACE_S:
            return asked_s
        fallen = before - asked_s
        return asked_s * max(1.0, (now - then) / fallen) if fallen > 0 else math.inf


def after_silence(figures: Mapping[str, float], silent_s: float) -> Mapping[str, float]:
    """The figures that were reported so long ago, of which more is left than they say by now."""
    left_s = figures.get("left_s", math.inf)
    if silent_s <= MIN_PACE_S + (MAX_OVERRUN_RATIO - 1) * left_s:
        return figures
    return {**figures, "left_s": _fallen_s(left_s, MIN_FALL * silent_s), "longer": 1.0}


def _fallen_s(left_s: float, by_s: float) -> float:
    return max(left_s - by_s, min(left_s, MIN_LEFT_S))


class Cancelled(Exception):
    """The work was asked to stop, and has nothing more to give."""


def ignore(progress: Progress) -> bool:
    """A report that nobody reads."""
    return False


def counted(
    items: Iterable[Item], total: int, report: Report, stage: str, unit: str
) -> Iterator[Item]:
    """The items, each reported as `unit` when the next one is asked for. Raises Cancelled where the
    report stops the work."""
    report(Progress(stage=stage))
    for number, item in enumerate(items, 1):
        yield item
        if report(Progress(number / total, stage, f"{unit} {number} of {total}")):
            raise Cancelled
