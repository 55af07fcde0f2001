"""Human-readable formatting of quantities and tables."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from .errors import printable


def format_duration(seconds: float) -> str:
    """ "45 s", "2 min", "1 h 30 min"."""
    whole = round(seconds)
    if whole < 100:
        return "1 min" if whole == 60 else f"{whole} s"
    minutes = round(whole / 60)
    if minutes < 100:
        return f"{minutes} min" if minutes * 60 == whole or whole > 600 else f"{whole / 60:.1f} min"
    return f"{minutes // 60} h {minutes % 60} min"


def format_bytes(size: float) -> str:
    """ "830 bytes", "12 kB", "3.4 MB", "120 MB", "2.5 GB", in powers of 1000."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= factor:
            value = size / factor
            return f"{value:.1f} {unit}" if value < 10 else f"{value:.0f} {unit}"
    return f"{size:.0f} bytes"


def format_name(path: Path) -> str:
    """A folder's name, or a file's without its suffix, as what is made of it is called."""
    resolved = path.resolve()
    return resolved.name if resolved.is_dir() else resolved.stem


def format_table(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Lines of labels and values, the values below each other, as a terminal may get them."""
    rows = [(printable(label), printable(value)) for label, value in rows]
    width = max((len(label) for label, _ in rows), default=0)
    return [f"{label:<{width}}  {value}" for label, value in rows]


QUALITIES_DB = {"Good": 30.0, "Usable": 25.0, "Rough": -math.inf}
"""Word for a held-out PSNR -> from which on."""


MIN_VISIBLE_GAIN_DB = 0.1
"""Gains that nobody sees are smaller."""
MORE_GAIN = "what may help: More Splats (--growth), or footage that shows it larger"
"""Advice where training a region further gains nothing visible."""


def describe_gain(before_db: float, after_db: float) -> str:
    """Accuracy of a region before and after it was trained further, and what would help."""
    gain = after_db - before_db
    gained = f"{before_db:.2f} dB before, {after_db:.2f} dB after ({gain:+.2f})"
    return gained if gain >= MIN_VISIBLE_GAIN_DB else f"{gained}; {MORE_GAIN}"


def describe_quality(figures: Mapping[str, float]) -> str:
    """A word for how good an avatar is, or for what was gained in its region; "" before its first
    evaluation."""
    if "before_db" in figures:
        gain = figures["after_db"] - figures["before_db"]
        return "Better" if gain >= MIN_VISIBLE_GAIN_DB else "No Better"
    psnr = figures.get("psnr", math.nan)
    return next((word for word, least in QUALITIES_DB.items() if psnr >= least), "")


def describe_left(figures: Mapping[str, float]) -> str:
    """The time that is left as a sentence; "" where it is not known."""
    left_s = figures.get("left_s", 0.0)
    if not left_s > 0:
        return ""
    return f"{'More than' if 'longer' in figures else 'About'} {format_duration(left_s)} left"


def describe_figures(figures: Mapping[str, float]) -> list[str]:
    """Figures of any work as short lines for a narrow panel, without those that are not known yet
    and the time that is left.

    per_second  iterations
    before_db, after_db  of the region that is trained further, `describe_gain`
    psnr, psnr_unmatched   of the last evaluation, dB, the second one without fitting the exposure
                           of views
    error_px, unexplained  of a tracked head: median distance from its landmarks, fraction of the
                           face that images do not look like
    """
    loss = ("loss", "loss {:.4f}")
    quality: tuple[tuple[tuple[str, str], ...], ...] = ((("psnr", "PSNR {:.2f} dB"), loss),)
    if "psnr_unmatched" in figures:
        matched = ("psnr", "PSNR {:.2f} dB (exposure fitted)")
        quality = ((matched, ("psnr_unmatched", "{:.2f} dB without")), (loss,))
    pairs = (
        (("per_second", "{:.1f} it/s"),),
        *quality,
        (
            ("error_px", "{:.1f} px off landmarks"),
            ("unexplained", "{:.0%} of the face unexplained"),
        ),
        (("splats", "{:,.0f} splats"), ("memory_mb", "{:.0f} MB memory")),
    )
    lines = []
    if "before_db" in figures:
        lines.append(describe_gain(figures["before_db"], figures["after_db"]))
    for pair in pairs:
        parts = []
        for name, text in pair:
            value = figures.get(name)
            if value and not math.isnan(value):
                parts.append(text.format(value))
        lines.append("   ".join(parts).replace(",", "\u202f"))
    return [line for line in lines if line]
