"""The schema by dataclasses of its own: what is allowed, what a message says, and JSON in both
directions."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from capture import factory
from refusal import refusal

from stga_addon import api
from stga_addon.errors import StgaError
from stga_addon.schema import from_json, setting, to_json, validate


@dataclass(frozen=True)
class Circle:
    radius: float = setting(1.0, above=0.0, maximum=9.0)


@dataclass(frozen=True)
class Square:
    side: int = setting(1, minimum=1, maximum=9)
    points: np.ndarray | None = None


@dataclass(frozen=True)
class Free:
    value: float


@dataclass(frozen=True)
class Cloud:
    points: np.ndarray


@dataclass(frozen=True)
class Drawing:
    count: int = setting(3, minimum=0)
    span: tuple[float, float] = setting((0.0, 1.0), minimum=0.0, maximum=1.0)
    steps: tuple[int, ...] = setting((), above=0)
    style: str = setting("plain", choices=("plain", "bold"))
    even: int = setting(2, accepts=lambda value: value % 2 == 0, expected="an even number")
    title: str | None = None
    path: Path | None = None
    filled: bool = False
    colors: Mapping[str, str] = field(default_factory=dict)
    frames: dict[int, Square] = field(default_factory=dict)
    main: Circle | Square = field(default_factory=Circle)
    others: tuple[Circle | Square, ...] = ()
    last: Square = field(default_factory=Square)

    def check(self):
        if self.count == 13:
            raise StgaError("13 is not drawn")


EVERYTHING = Drawing(
    count=0,
    span=(0.0, 1),
    steps=(1, 2),
    style="bold",
    title="Zoë",
    path=Path("/a/b"),
    filled=True,
    colors={"sky": "blue"},
    frames={-3: Square(9), 12: Square(1)},
    main=Square(2),
    others=(Circle(9.0), Square(3)),
    last=Square(4, np.arange(6.0).reshape(2, 3)),
)


FRACTIONS = "expected a tuple, each item a finite number from 0.0 up to 1.0"
SIDE = "expected a whole number from 1 up to 9"
KINDS = "expected one of Circle, Square"


def test_round_trip():
    """Catches a field that is lost, takes another type, or is confused with an alternative of the
    same form."""
    arrays = {}
    plain = to_json(EVERYTHING, arrays)
    again = from_json(Drawing, json.loads(json.dumps(plain)), arrays=arrays)
    for name, value in vars(EVERYTHING).items():
        if name != "last":
            assert getattr(again, name) == value, name
            assert type(getattr(again, name)) is type(value), name
    assert list(arrays) == ["last.points"]
    assert plain["last"] == {"side": 4, "points": {"array": "last.points"}}
    np.testing.assert_array_equal(again.last.points, EVERYTHING.last.points)
    assert plain["main"] == {"kind": "Square", "side": 2, "points": None}
    assert [each["kind"] for each in plain["others"]] == ["Circle", "Square"]
    assert plain["frames"]["12"] == {"side": 1, "points": None}
    assert from_json(Circle | Square, to_json(Square(5), kinds=Circle | Square)) == Square(5)


REFUSED = [
    ({"count": -1}, "setting count: expected a whole number from 0, got -1"),
    ({"count": 1.0}, "setting count: expected a whole number from 0, got 1.0"),
    ({"count": True}, "setting count: expected a whole number from 0, got True"),
    ({"count": 13}, "13 is not drawn"),
    ({"span": (0.0, 1.5)}, f"setting span: {FRACTIONS}, got "),
    ({"span": (0.0, math.nan)}, f"setting span: {FRACTIONS}, got "),
    ({"span": (0.0,)}, "setting span: expected a tuple of 2, got "),
    ({"span": [0.0, 1.0]}, "setting span: expected a tuple of 2, got "),
    ({"steps": (1, 0)}, "setting steps: expected a tuple, each item a whole number above 0, got "),
    ({"steps": 1}, "setting steps: expected a tuple, got 1"),
    ({"style": "thin"}, "setting style: expected one of plain, bold, got 'thin'"),
    ({"style": None}, "setting style: expected one of plain, bold, got None"),
    ({"even": 3}, "setting even: expected an even number, got 3"),
    ({"title": 3}, "setting title: expected a text, got 3"),
    ({"path": "/a"}, "setting path: expected a path, got '/a'"),
    ({"filled": 1}, "setting filled: expected True or False, got 1"),
    ({"colors": {"sky": 3}}, "setting colors: expected texts by name, got "),
    ({"colors": {3: "blue"}}, "setting colors: expected texts by name, got "),
    ({"colors": ()}, "setting colors: expected an object of Mapping, got "),
    ({"frames": {"1": Square()}}, "setting frames: expected values by name, got "),
    ({"main": 3}, "setting main: expected an object of Circle or an object of Square, got 3"),
    ({"main": Circle(0.0)}, "setting main.radius: expected a finite number above 0.0 up to 9.0"),
    ({"others": (Circle(), Square(10))}, f"setting others.1.side: {SIDE}, got 10"),
    ({"last": Square(1, [1])}, "setting last.points: expected an array, got "),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_is_not_allowed(changes, message):
    """Catches a limit that does not hold, or holds for the value at its end, and a message about
    another field."""
    with refusal(f"^{re.escape(message)}"):
        validate(Drawing(**changes))


def test_limits():
    """Catches an inclusive limit that excludes its value, whole numbers that are refused as finite
    ones, and one given so that overflows where it is counted with, at either sign."""
    largest = (1 << 31) - 1
    for radius in (9.0, 9, 5e-324):
        validate(Circle(radius))
    for allowed in (Square(1), Square(9), Free(largest), Free(-largest)):
        validate(allowed)
    for value in (1 << 31, -(1 << 31)):
        with refusal("setting value: expected a finite number, got"):
            validate(Free(value))


OTHER_FORMS = [
    ({"frames": {"x": {}}}, "d: setting frames: expected whole numbers as names, got 'x'"),
    ({"frames": {"1": {"side": 1}}}, "d: frames.1: fields are missing or unknown (points)"),
    ({"main": {"side": 1, "points": None}}, f"d: setting main.kind: {KINDS}, got None"),
    ({"main": {"kind": "Cube"}}, f"d: setting main.kind: {KINDS}, got 'Cube'"),
    ({"main": {"kind": "Circle", "side": 1}}, "d: main: fields are missing or unknown (radius, si"),
    ({"main": None}, f"d: setting main.kind: {KINDS}, got None"),
    ({"others": [{"kind": "Circle"}]}, "d: others.0: fields are missing or unknown (radius)"),
    ({"last": 3}, "d: last: fields are missing or unknown (points, side)"),
    (
        {"last": {"side": 1, "points": {"array": "nowhere"}, "more": 1}},
        "d: last: fields are missing or unknown (more)",
    ),
    ({"last": {"side": 0, "points": None}}, f"d: setting last.side: {SIDE}, got 0"),
    ({"more": 1}, "d: fields are missing or unknown (more)"),
    ({"path": "a\0b"}, "d: setting path: 'a\\x00b' is not a usable path"),
    ({"path": "a\ud800"}, "d: setting path: 'a\\ud800' is not a usable path"),
    ({"path": 300 * "a"}, "d: setting path: 'aaa"),
]


@pytest.mark.parametrize(("changes", "message"), OTHER_FORMS)
def test_json_of_another_form(changes, message):
    """Catches a traceback for a file edited by hand, and a message that does not say where the
    mistake is."""
    plain = to_json(Drawing())
    with refusal(f"^{re.escape(message)}"):
        from_json(Drawing, {**plain, **changes}, "d")


@pytest.mark.parametrize("named", ["nowhere", 3, None, []])
def test_an_array_that_is_not_there(named):
    """Catches an array that is required and missing, taken for one that may be left out."""
    plain = {"points": {"array": named}}
    with refusal("setting points: expected an array, got None"):
        from_json(Cloud, plain, arrays={"points": np.zeros(3)})
    found = from_json(Cloud, {"points": {"array": "a"}}, arrays={"a": np.zeros(3)})
    assert found.points.shape == (3,)


class Named:
    """An os.PathLike of other people."""

    def __init__(self, path):
        self.path = path

    def __fspath__(self):
        return str(self.path)


@pytest.mark.parametrize("kind", [str, Path, Named])
def test_the_python_interface_takes_names_as_paths(tmp_path, kind):
    """Catches an AttributeError of a function, or a request, whose path is a str or an
    os.PathLike."""
    root = factory.write_mesh_capture(tmp_path / "ball")
    capture = api.open_capture(kind(root))
    assert len(capture.timesteps) > 0
    avatar = tmp_path / "a.npz"
    factory.write_avatar_of(capture, avatar)
    splats = api.read_avatar(kind(avatar)).splats
    api.write_avatar(kind(avatar), api.read_avatar(path=kind(avatar)))
    api.write_ply(kind(tmp_path / "a.ply"), splats)
    assert len(api.read_splats(kind(tmp_path / "a.ply"))) == len(splats)
    api.perform(api.Export(kind(avatar), kind(tmp_path / "b.ply"), "ply"), log=lambda _: None)
    assert (tmp_path / "b.ply").stat().st_size > 1000
    with refusal("'a.x00b' is not a usable path"):
        api.read_splats("a\0b")
