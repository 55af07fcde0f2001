"""Progress of work, whatever it is, and how it is reported and cancelled."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from .format import format_duration

Item = TypeVar("Item")


@dataclass(frozen=True)
class Progress:
    """How far the work is.

    share     0 to 1
    stage     what is being done; detail: more about it
    figures   gives named numbers that depend on the kind of work, NaN where one is not known yet
    preview   writes the result so far into a file; None before there is one
    picture   draws the result so far, (H, W, 3) uint8, or nothing; None where nothing new is to be seen
    """

    share: float = 0.0
    stage: str = ""
    detail: str = ""
    figures: Callable[[], Mapping[str, float]] = dict
    preview: Callable[[Path], None] | None = None
    picture: Callable[[], np.ndarray | None] | None = None


Report = Callable[[Progress], bool]
"""Called now and then; returns True to stop and keep what there is."""
Say = Callable[[str], None]
"""Called with a line for people."""


class Cancelled(Exception):
    """The work was asked to stop, and has nothing more to give."""


def ignore(progress: Progress) -> bool:
    """A report that nobody reads."""
    return False


def counted(items: Iterable[Item], total: int, report: Report, stage: str, unit: str) -> Iterator[Item]:
    """The items, of which each is reported when the next one is asked for; unit: what one of them is called.

    Raises Cancelled where the report says to stop.
    """
    report(Progress(stage=stage))
    for number, item in enumerate(items, 1):
        yield item
        if report(Progress(number / total, stage, f"{unit} {number} of {total}")):
            raise Cancelled


def describe_figures(figures: Mapping[str, float]) -> list[str]:
    """Figures of a training as short lines for a narrow panel, without those that are not known yet."""
    loss = ("loss", "loss {:.4f}")
    quality: tuple[tuple[tuple[str, str], ...], ...] = ((("psnr", "PSNR {:.2f} dB"), loss),)
    if "psnr_unmatched" in figures:
        quality = (("psnr", "PSNR {:.2f} dB (exposure fitted)"), ("psnr_unmatched", "{:.2f} dB without")), (loss,)
    pairs = (
        (("per_second", "{:.1f} it/s"), ("left_s", "{} left")),
        *quality,
        (("splats", "{:,.0f} splats"), ("memory_mb", "{:.0f} MB memory")),
    )
    lines = []
    for pair in pairs:
        known = [
            (text, figures[name], name) for name, text in pair if figures.get(name) and not math.isnan(figures[name])
        ]
        parts = [text.format(format_duration(value) if name == "left_s" else value) for text, value, name in known]
        lines.append("   ".join(parts).replace(",", "\u202f"))
    return [line for line in lines if line]
