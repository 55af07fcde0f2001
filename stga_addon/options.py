"""Fields of dataclasses as options: of the command line; of Blender in `operators/options.py`."""

import dataclasses
import math
import re
from argparse import ArgumentTypeError, Namespace
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin

from .errors import StgaError, shorten
from .schema import alternatives, expectation, setting, type_hints, usable_path

MAX_DIGITS = 18  # Digits of a whole number on the command line, which fits 64 bits


@dataclasses.dataclass(frozen=True)
class When:
    """A case in which an option has an effect.

    holds      of a request, or of the options of a command by the same names
    otherwise  what follows "has no effect", with values in braces, as {source}
    """

    holds: Callable[[Any], bool]
    otherwise: str


Need = str | tuple[str, ...] | When


def option(
    help: str,
    default: Any = dataclasses.MISSING,
    minimum: float = -math.inf,
    maximum: float = math.inf,
    *,
    flag: str = "",
    metavar: str = "",
    parse: Callable[[str], Any] | None = None,
    bare: Any = None,
    offered: Collection[str] | None = None,
    group: str = "",
    needs: "tuple[Need, ...]" = (),
    **limits: Any,
) -> Any:
    """A dataclass field that people choose, with its limits (`schema.setting`).

    help     what it is, for command line and tooltip; of a field that is a dataclass, the title of
             its options
    flag     its name on the command line, by default the field's; without dashes: it is given by
             position
    parse    text -> value, and of a mapping a name and a value, where its type does not say how
    bare     the value where the option is given alone
    offered  those of the field's choices that people have
    group    options of one group exclude each other
    needs    what has to hold, else it has no effect and is refused: fields that have to be given
             with it, of a tuple one, and cases (`When`)
    """
    asked = {"help": help, "flag": flag, "metavar": metavar, "parse": parse, "bare": bare}
    asked |= {"group": group, "needs": needs, "offered": offered or limits.get("choices")}
    return setting(default, minimum, maximum, **limits, **asked)


def like(kind: Any, name: str, **changes: Any) -> Any:
    """A field as that of another dataclass; changes: of `default` and its metadata."""
    spec = kind.__dataclass_fields__[name]
    default = changes.pop("default", spec.default)
    return dataclasses.field(default=default, metadata={**spec.metadata, **changes})


def flag_of(spec: Any) -> str:
    """How the command line calls a field."""
    return str(spec.metadata.get("flag") or f"--{spec.name.replace('_', '-')}")


def option_fields(kind: Any) -> Iterator[Any]:
    """The fields of a dataclass that are options."""
    return (spec for spec in dataclasses.fields(kind) if spec.metadata.get("help"))


# The command line


def add_options(parser: Any, kind: Any, *names: str, may_lack: Collection[str] = ()) -> None:
    """Add an argument for each option of a dataclass, or those of `names`; its dataclasses are
    groups. may_lack: fields without a default that need not be given."""
    hints = type_hints(kind)
    groups = {"": parser}
    for spec in option_fields(kind):
        hint = hints[spec.name]
        asked = spec.metadata
        if names and spec.name not in names:
            continue
        if dataclasses.is_dataclass(hint):
            add_options(parser.add_argument_group(asked["help"]), hint)
            continue
        if asked["group"] not in groups:
            groups[asked["group"]] = parser.add_mutually_exclusive_group()
        has_default = {spec.default, spec.default_factory} != {dataclasses.MISSING}
        is_required = not has_default and spec.name not in may_lack
        form = _form(spec, hint, is_required)
        groups[asked["group"]].add_argument(*form.pop("names"), **form)


def _form(spec: Any, hint: Any, is_required: bool) -> dict[str, Any]:
    """What `add_argument` takes for a field, by its type."""
    (kind,) = (k for k in alternatives(hint) if k is not NoneType)
    asked = spec.metadata
    default = spec.default
    flag = flag_of(spec)
    is_named = flag.startswith("-")
    help = str(asked["help"])
    is_number = isinstance(default, int | float) and not isinstance(default, bool)
    if (is_number or (isinstance(default, str | Path) and default != "")) and "default" not in help:
        help += f" (default {default:g})" if is_number else f" (default {default})"
    form: dict[str, Any] = {"help": help.replace("%", "%%"), "default": None}
    if is_named:
        form |= {"names": (flag,), "dest": spec.name, "required": is_required}
    else:
        form |= {"names": (spec.name,), "metavar": flag, **({} if is_required else {"nargs": "?"})}
    if kind is bool:
        return {**form, "action": "store_true"}
    several = get_origin(kind) is tuple and get_args(kind)[-1] is Ellipsis
    if get_origin(kind) is Mapping or (several and is_named):
        form["action"] = "append"
    elif several:
        form["nargs"] = "+" if is_required else "*"
    elif asked["bare"] is not None:
        form |= {"nargs": "?", "const": asked["bare"]}
    if asked["offered"] is not None:
        return {**form, "choices": tuple(asked["offered"])}
    form["type"] = _parser(get_args(kind)[0] if several else kind, asked)
    return {**form, "metavar": asked["metavar"]} if asked["metavar"] else form


def given_options(options: Namespace, kind: Any) -> dict[str, Any]:
    """Field -> value of what was given on the command line."""
    hints = type_hints(kind)
    found = dict[str, Any]()
    for spec in option_fields(kind):
        hint = hints[spec.name]
        value = getattr(options, spec.name, None)
        if dataclasses.is_dataclass(hint):
            value = hint(**given_options(options, hint))  # type: ignore[operator]
        elif isinstance(value, list):
            is_mapping = any(get_origin(part) is Mapping for part in alternatives(hint))
            value = dict(value) if is_mapping else tuple(value)
        if value is not None:
            found[spec.name] = value
    return found


def refuse_useless(value: Any, *kinds: Any) -> None:
    """Raise StgaError for the first option that is given without effect, by its `needs`.

    value: a dataclass of options, or the Namespace of those of the dataclasses `kinds`.
    """
    options = [*_nested_options(*(kinds or (type(value),)))]
    flags = {each.spec.name: flag_of(each.spec) for each in options}
    for each in options:
        problem = _problem(value, each.needs, flags) if each.is_given(value) else None
        if problem is not None:
            raise StgaError(f"{flag_of(each.spec)}: has no effect {problem}")


def serves(options: Namespace, name: str, *kinds: Any) -> bool:
    """Whether an option of a command would have an effect."""
    needs = (each.needs for each in _nested_options(*kinds) if each.spec.name == name)
    return all(_problem(options, each, {}) is None for each in needs)


@dataclasses.dataclass(frozen=True)
class _NestedOption:
    """An option, the field of the dataclass that it is in where that is nested, and all needs."""

    spec: Any
    within: str
    needs: tuple[Need, ...]

    def is_given(self, value: Any) -> bool:
        nested = self.within and not isinstance(value, Namespace)
        return _is_given(getattr(value, self.within) if nested else value, self.spec.name)


def _nested_options(*kinds: Any) -> Iterator[_NestedOption]:
    for kind in kinds:
        hints = type_hints(kind)
        for spec in option_fields(kind):
            needs = spec.metadata["needs"]
            if not dataclasses.is_dataclass(hints[spec.name]):
                yield _NestedOption(spec, "", needs)
                continue
            for each in option_fields(hints[spec.name]):
                yield _NestedOption(each, spec.name, (*needs, *each.metadata["needs"]))


def _is_given(value: Any, name: str) -> bool:
    if isinstance(value, Namespace):
        return getattr(value, name, None) is not None
    spec = value.__dataclass_fields__[name]
    is_made = spec.default_factory is not dataclasses.MISSING
    default = spec.default_factory() if is_made else spec.default
    return bool(getattr(value, name) != default)


def _problem(value: Any, needs: tuple[Need, ...], flags: Mapping[str, str]) -> str | None:
    """What follows "has no effect", where one of the needs is not met."""
    for need in needs:
        if isinstance(need, When):
            if not need.holds(value):
                return need.otherwise.format_map(vars(value))
            continue
        names = (need,) if isinstance(need, str) else need
        if not any(_is_given(value, name) for name in names):
            return f"without {' or '.join(flags.get(name, f'--{name}') for name in names)}"
    return None


# Values on the command line


def _parser(kind: Any, limits: Mapping[str, Any]) -> Callable[[str], Any]:
    """The type of an argument: text -> value that the field allows."""
    convert = limits["parse"] or _CONVERSIONS[kind]

    def parse(text: str) -> Any:
        try:
            value = convert(text)
        except StgaError as error:
            raise ArgumentTypeError(str(error)) from error
        except ValueError:
            value = text  # which is not what is expected
        wrong = None if get_origin(kind) is Mapping else expectation(value, kind, limits)
        if wrong is not None:
            raise ArgumentTypeError(f"expected {wrong}, got {shorten(text)}")
        return value

    return parse


def _whole_number(text: str) -> Any:
    return int(text) if re.fullmatch(rf"-?\d{{1,{MAX_DIGITS}}}", text, re.ASCII) else text


def frame_span(text: str) -> tuple[int, int]:
    """ "10:20" or "10-20", both included. Raises StgaError for anything else."""
    match = re.fullmatch(r"(\d{1,18})[:-](\d{1,18})", text, re.ASCII)
    first, last = (int(part) for part in match.groups()) if match else (1, 0)
    if first > last:
        raise StgaError(f"'{text}' is not a range of frames such as 10:20 or 10-20")
    return first, last


def duration(text: str) -> float:
    """Seconds in "90", "90s", "10m", "1h30m", "1h30", more than 0. Raises StgaError for anything
    else."""
    number = r"(\d+(?:\.\d+)?)"
    match = re.fullmatch(rf"(?:{number}h)?(?:{number}m)?(?:{number}(s?))?", text.strip(), re.ASCII)
    if not match or not any(match.groups()):
        raise StgaError(f"'{text}' is not a time such as 90s, 10m or 1h30m")
    hours, minutes, seconds = (float(part or 0) for part in match.groups()[:3])
    if match[1] and not match[2] and not match[4]:  # what follows the hours alone
        minutes = seconds
        seconds = 0.0
    total = 3600 * hours + 60 * minutes + seconds
    if not 0 < total < math.inf:
        raise StgaError(f"'{text}' is not a positive time")
    return total


def color(text: str) -> tuple[float, float, float]:
    """ "white", "black" or three numbers in 0…1. Raises StgaError for anything else."""
    named = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
    if text in named:
        return named[text]
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        red = green = blue = -1.0
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise StgaError(f"'{text}' is not white, black or R,G,B with numbers in 0…1")
    return red, green, blue


_CONVERSIONS: dict[Any, Callable[[str], Any]] = {
    str: str,
    Path: usable_path,
    int: _whole_number,
    float: float,
    tuple[int, int]: frame_span,
    tuple[float, float, float]: color,
}  # Type of a field -> what reads its values; what it cannot read, `schema.expectation` refuses
