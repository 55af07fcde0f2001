"""Human-readable formatting of quantities and tables."""

from collections.abc import Sequence


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


def format_table(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Lines of labels and values, the values below each other."""
    width = max((len(label) for label, _ in rows), default=0)
    return [f"{label:<{width}}  {value}" for label, value in rows]
