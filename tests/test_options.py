"""Options by dataclasses of their own: what the command line reads, refuses and leaves at the
defaults."""

from argparse import ArgumentParser
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
from refusal import refusal

from stga_addon.options import (
    add_options,
    color,
    duration,
    given_options,
    like,
    option,
    refuse_useless,
)


@dataclass(frozen=True)
class Frame:
    width: float = option("of the frame", 1.0, 0, 9)


@dataclass(frozen=True)
class Drawing:
    source: Path = option("what is drawn", flag="SOURCE")
    output: Path = option("the drawing", flag="--out")
    count: int = option("of strokes", 3, 1, 9)
    seconds: float | None = option("time", None, 0, flag="--time", parse=duration, group="budget")
    strokes: int | None = option("instead of a time", None, 1, group="budget")
    style: str = option(
        "of strokes", "plain", choices=("plain", "bold", "own"), offered=("plain", "bold")
    )
    turn: float | None = option("degrees", None, 0, 360, bare=0.0)
    frames: tuple[int, int] | None = option("first and last", None)
    color: tuple[float, float, float] = option("of strokes", (1.0, 1.0, 1.0), 0, 1)
    tones: tuple[str, ...] = option(
        "may be repeated", (), choices=("dark", "light"), needs=("shaded",)
    )
    shifts: Mapping[str, int] | None = option(
        "NAME=N", None, parse=lambda text: (text[:-2], int(text[-1]))
    )
    shaded: bool = option("with shades", False, needs=(("seconds", "strokes"),))
    again: float = like(Frame, "width", default=2.0)
    frame: Frame = option("frame", default_factory=Frame, needs=("shaded",))
    hidden: int = 5


def parsed(*words):
    parser = ArgumentParser()
    add_options(parser, Drawing)
    return given_options(parser.parse_args(["a.png", "--out", "b", *words]), Drawing)


def test_what_is_given_reaches_its_field():
    """Catches an option that is lost, of another type or in another field, and a default that hides
    the dataclass's."""
    assert Drawing(**parsed()) == Drawing(Path("a.png"), Path("b"))
    line = "--count 4 --time 1m --style bold --turn --frames 2-7 --color 0,1,0.5"
    more = "--tones dark --tones light --shifts left=3 --shifts x=1 --shaded --again 3 --width 4"
    assert Drawing(**parsed(*line.split(), *more.split())) == Drawing(
        Path("a.png"),
        Path("b"),
        4,
        60.0,
        None,
        "bold",
        0.0,
        (2, 7),
        (0.0, 1.0, 0.5),
        ("dark", "light"),
        {"left": 3, "x": 1},
        True,
        3.0,
        Frame(4.0),
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--count 0", "argument --count: expected a whole number from 1 up to 9, got '0'"),
        ("--count 1.5", "argument --count: expected a whole number"),
        ("--turn 361", "argument --turn: expected a finite number from 0 up to 360"),
        ("--width nan", "argument --width: expected a finite number from 0 up to 9"),
        ("--time soon", "argument --time: 'soon' is not a time"),
        ("--time 1s --strokes 3", "not allowed with argument"),
        ("--style own", "invalid choice: 'own'"),
        ("--color 0,1,2", "argument --color: '0,1,2' is not white, black or R,G,B"),
        ("--frames 7-2", "argument --frames: '7-2' is not a range"),
        ("--hidden 3", "unrecognized arguments: --hidden 3"),
    ],
)
def test_values_without_meaning(words, message, capsys):
    """Catches limits that the command line does not know, and a refusal that does not name the
    option."""
    with pytest.raises(SystemExit, match="2"):
        parsed(*words.split())
    assert message in capsys.readouterr().err


DURATIONS = {
    "90": 90,
    "90s": 90,
    "10m": 600,
    "1h30m": 5400,
    "1h": 3600,
    "1.5m": 90,
    "1m30": 90,
    " 2m ": 120,
    "1h30": 5400,
    "1h30s": 3630,
    "1h0m30": 3630,
    "0.5h15": 2700,
}
COLORS = {
    "white": (1, 1, 1),
    "black": (0, 0, 0),
    "0.25,1,0": (0.25, 1, 0),
    "0, .5 ,1.0": (0, 0.5, 1),
}
NO_DURATIONS = "", "s", "m", "-5", "ten", "5d", "1e3", "nan", "inf", "5 m", "30s10m", "1,5m", "٣"
NO_COLORS = "", "red", "1,1", "1,1,1,1", "255,0,0", "0,-0.1,0", "nan,0,0", "0,0,inf", "a,b,c"


def test_times_and_colors():
    """Catches minutes taken for seconds, also where no unit names them, 0…255 taken for 0…1,
    channels in another order, and a value that means something else than what was typed."""
    assert {text: duration(text) for text in DURATIONS} == DURATIONS
    assert {text: color(text) for text in COLORS} == COLORS
    for read, texts, message in (
        (duration, NO_DURATIONS, "is not a time such as"),
        (color, NO_COLORS, "is not white, black or R,G,B"),
    ):
        for text in texts:
            with refusal(message):
                read(text)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--shaded", "--shaded: has no effect without --time or --strokes"),
        ("--tones dark", "--tones: has no effect without --shaded"),
        ("--width 3", "--width: has no effect without --shaded"),
    ],
)
def test_options_that_need_others(words, message):
    """Catches an option that is ignored without a message, and one that is refused where it has an
    effect."""
    refuse_useless(Drawing(**parsed("--shaded", "--strokes", "3", "--tones=dark", "--width=3")))
    with refusal(f"^{message}$"):
        refuse_useless(Drawing(**parsed(*words.split())))
