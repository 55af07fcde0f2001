"""Types of option values: times, colors, numbers."""

import pytest

from stga_addon.errors import StgaError
from stga_addon.options import color, duration


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("90", 90), ("90s", 90), ("10m", 600), ("1h30m", 5400), ("1h", 3600), ("1.5m", 90),
        ("1m30", 90), (" 2m ", 120),
    ],
)  # fmt: skip
def test_durations(text: str, seconds: float) -> None:
    """Catches minutes taken for seconds."""
    assert duration(text) == seconds


@pytest.mark.parametrize(
    "text", ["", "s", "m", "-5", "ten", "5d", "1e3", "nan", "inf", "5 m", "30s10m", "1,5m", "٣"]
)
def test_durations_that_are_none(text: str) -> None:
    """Catches a budget that means something else than what was typed."""
    with pytest.raises(StgaError, match="is not a time such as"):
        duration(text)


def test_colors() -> None:
    """Catches channels in another order or range."""
    assert color("white") == (1, 1, 1)
    assert color("black") == (0, 0, 0)
    assert color("0.25,1,0") == (0.25, 1, 0)
    assert color("0, .5 ,1.0") == (0, 0.5, 1)


@pytest.mark.parametrize(
    "text",
    ["", "red", "1,1", "1,1,1,1", "255,0,0", "0,-0.1,0", "-1,0,0", "nan,0,0", "0,0,inf", "a,b,c"],
)
def test_colors_that_are_none(text: str) -> None:
    """Catches 0…255 taken for 0…1, and values that would wrap around in the image."""
    with pytest.raises(StgaError, match="is not white, black or R,G,B"):
        color(text)
