"""Dataclasses whose fields state their allowed values: validation, and JSON in both directions."""

import dataclasses
import errno
import inspect
import math
import os
import re
import types
from collections.abc import Callable, Collection, Mapping
from dataclasses import field
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from .errors import StgaError, shorten

P = ParamSpec("P")
R = TypeVar("R")
MAX_COUNT = (1 << 31) - 1  # Largest whole number that kernels can count to
KIND = "kind"  # Key that names the dataclass where a field may hold one of several
ARRAY = "array"  # Key of an array's place in JSON: its name among the arrays beside it
IS_PATH = "is_path"  # Key of a field's metadata: of `setting`
MAX_NAME_BYTES = 255  # Longest name of a file or folder

Arrays = dict[str, np.ndarray]


def setting(
    default: Any = dataclasses.MISSING,
    minimum: float = -math.inf,
    maximum: float = math.inf,
    above: float = -math.inf,
    choices: Collection[str] | None = None,
    accepts: Callable[[Any], bool] | None = None,
    expected: str = "",
    is_path: Callable[[str], bool] | None = None,
    default_factory: Any = dataclasses.MISSING,
    **option: Any,
) -> Any:
    """A dataclass field with its allowed values; the bounds hold for each number of a tuple.

    minimum, maximum  inclusive; above: exclusive lower bound
    choices           allowed texts; a mapping also says what each is
    accepts           whether a value of the right type is allowed, and `expected`: what it accepts,
                      for the message
    is_path           whether a text is that of a path, where it can be a name as well
    option            what the command line and Blender ask for it with (`options.option`)
    """
    limits = {"minimum": minimum, "maximum": maximum, "above": above, "choices": choices}
    metadata = {**limits, "accepts": accepts, "expected": expected, IS_PATH: is_path, **option}
    if default_factory is not dataclasses.MISSING:
        return field(default_factory=default_factory, metadata=metadata)
    return field(default=default, metadata=metadata)


# Validation


def validate(value: Any, prefix: str = "") -> None:
    """Raise StgaError naming the first field of a dataclass, nested ones included, that is not
    allowed. A field is allowed by its type hint and the limits of `setting`; what fields must have
    in common, a dataclass says in a method `check()` that raises StgaError."""
    hints = type_hints(type(value))  # type: ignore[arg-type]
    for spec in dataclasses.fields(value):
        found = getattr(value, spec.name)
        hint = hints[spec.name]
        expected = expectation(found, hint, spec.metadata)
        if expected is not None:
            raise StgaError(complaint(prefix + spec.name, expected, found))
        several = isinstance(found, tuple)
        for row, part in enumerate(found if several else (found,)):
            if dataclasses.is_dataclass(part):
                name = f"{spec.name}.{row}" if several else spec.name
                validate(part, f"{prefix}{name}.")
    if hasattr(value, "check"):
        value.check()


def complaint(name: str, expected: str, value: Any) -> str:
    """The message for a field with a value that is not allowed."""
    return f"setting {name}: expected {expected}, got {shorten(value)}"


# Paths


def usable_path(text: str) -> Path:
    """Raises StgaError for a name that no file can have (empty, too long or with a NUL), that is
    not UTF-8, folders above included, or relative where the folder it counts from was removed."""
    try:
        os.lstat(text)
        too_long = False
    except OSError as error:
        too_long = error.errno == errno.ENAMETOOLONG
    except ValueError as error:  # a NUL, or a character that file names cannot encode
        raise StgaError(f"'{text}' is not a usable path ({error})") from error
    # The system looks at names in turn and stops at the first that is missing.
    if too_long or any(len(os.fsencode(part)) > MAX_NAME_BYTES for part in Path(text).parts):
        raise StgaError(f"'{text}' is not a usable path (too long)")
    if not text:
        raise StgaError("the path is empty")
    check_encodable(Path(text))
    return Path(text)


def check_encodable(path: Path) -> None:
    """Raise StgaError where the path or a folder above is not named in UTF-8: the JSON of runs and
    requests, USD and other libraries cannot hold it. Also where the path is relative, and the
    folder in which this process works was removed."""
    try:
        whole = os.path.abspath(path)
    except FileNotFoundError as error:
        problem = "the working folder was removed; change to one that exists"
        raise StgaError(f"{path}: is not a usable path ({problem})") from error
    try:
        os.fsencode(whole).decode("utf-8")  # as the system stores it, whatever the locale
    except UnicodeDecodeError as error:
        problem = "the name of this file or of a folder above is not UTF-8; rename it"
        raise StgaError(f"{whole}: is not a usable path ({problem})") from error


def takes_paths(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which also takes a str or an os.PathLike where it expects a Path, or a
    dataclass with such fields. Raises StgaError for a name that no file can have."""
    signature = inspect.signature(function, eval_str=True)

    @wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> R:
        bound = signature.bind(*arguments, **named)
        for name, value in bound.arguments.items():
            bound.arguments[name] = _with_path(signature.parameters[name].annotation, value)
        return function(*bound.args, **bound.kwargs)

    return call


def _with_path(hint: Any, value: Any) -> Any:
    kinds = alternatives(hint)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        hints = type_hints(type(value))
        found = {spec.name: getattr(value, spec.name) for spec in dataclasses.fields(value)}
        paths = {name: _with_path(hints[name], entry) for name, entry in found.items()}
        changed = {name: entry for name, entry in paths.items() if entry is not found[name]}
        return dataclasses.replace(value, **changed) if changed else value
    if tuple[Path, ...] in kinds and isinstance(value, (tuple, list)):
        return tuple(_with_path(Path, item) for item in value)
    if Path in kinds and str not in kinds and isinstance(value, (str, os.PathLike)):
        return value if isinstance(value, Path) else usable_path(os.fspath(value))
    return value


# Type hints


@cache
def type_hints(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {name: hint for name, hint in hints.items() if hint is not dataclasses.KW_ONLY}


def alternatives(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a type hint; None is `types.NoneType`."""
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def expectation(value: Any, hint: Any, limits: Mapping[str, Any]) -> str | None:
    """What `value` should have been by its type and its limits; None where it is allowed."""
    kinds = alternatives(hint)
    if value is None and types.NoneType in kinds:
        return None
    found = [_expected_kind(value, kind, limits) for kind in kinds if kind is not types.NoneType]
    if None not in found:
        return " or ".join(dict.fromkeys(map(str, found)))
    accepts = limits.get("accepts")
    return None if accepts is None or accepts(value) else str(limits["expected"])


def _expected_kind(value: Any, kind: Any, limits: Mapping[str, Any]) -> str | None:
    origin = get_origin(kind) or kind
    if origin is tuple:
        hints = get_args(kind)
        size = None if hints[-1] is Ellipsis else len(hints)
        if not isinstance(value, tuple) or size not in (None, len(value)):
            return "a tuple" if size is None else f"a tuple of {size}"
        found = (expectation(item, hints[0], limits) for item in value)
        return next((f"a tuple, each item {text}" for text in found if text is not None), None)
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping):
            return "an object of Mapping"
        names, values = get_args(kind)
        wrong = (expectation(item, values, limits) for item in value.values())
        if all(isinstance(key, names) for key in value) and not any(wrong):
            return None
        return "texts by name" if (names, values) == (str, str) else "values by name"
    if kind in (int, float):
        low = limits.get("minimum", -math.inf)
        above = limits.get("above", -math.inf)
        high = limits.get("maximum", math.inf)
        if kind is int:
            fits = isinstance(value, int)
        else:
            fits = isinstance(value, float) and math.isfinite(value)
            fits = fits or (isinstance(value, int) and abs(value) <= MAX_COUNT)
        if fits and not isinstance(value, bool) and low <= value <= high and value > above:
            return None
        expected = "a whole number" if kind is int else "a finite number"
        if above > -math.inf:
            expected += f" above {above}"
        elif low > -math.inf:
            expected += f" from {low}"
        return f"{expected} up to {high}" if high < math.inf else expected
    choices = limits.get("choices") if kind is str else None
    if isinstance(value, origin) and (choices is None or value in choices):
        return None
    if choices is not None:
        return f"one of {', '.join(choices)}"
    known = {str: "a text", bool: "True or False", Path: "a path", np.ndarray: "an array"}
    return known.get(origin, f"an object of {origin.__name__}")


# JSON


def to_json(value: Any, arrays: Arrays | None = None, kinds: Any = None, name: str = "") -> Any:
    """A dataclass as plain values of JSON, which `from_json` reads back. Paths become texts, tuples
    lists, and a dataclass where a field allows several an object with its `kind`. Arrays are put
    into `arrays`, which must then be kept beside the JSON. kinds: type hint of `value`; default:
    its type. name: its place in the whole, of which arrays are named."""
    kinds = alternatives(kinds or type(value))

    def plain(key: Any, item: Any, hint: Any) -> Any:
        return to_json(item, arrays, hint, _joined(name, str(key)))

    if dataclasses.is_dataclass(value):
        hints = type_hints(type(value))  # type: ignore[arg-type]
        fields = {key: plain(key, getattr(value, key), hint) for key, hint in hints.items()}
        several = sum(dataclasses.is_dataclass(kind) for kind in kinds) > 1
        return {KIND: type(value).__name__, **fields} if several else fields
    if isinstance(value, np.ndarray):
        assert arrays is not None, f"{name}: an array, and nothing to keep it in"
        arrays[name] = value
        return {ARRAY: name}
    if isinstance(value, Path):
        return str(value)
    items: Any = next((get_args(kind) for kind in kinds if kind is not types.NoneType), ())
    if isinstance(value, Mapping):
        hint = items[1] if items else Any
        return {str(key): plain(key, item, hint) for key, item in value.items()}
    if isinstance(value, tuple):
        hint = items[0] if items else Any
        return [plain(row, item, hint) for row, item in enumerate(value)]
    return value


def _joined(name: str, part: str) -> str:
    return f"{name}.{part}" if name else part


def from_json(
    kind: Any, values: Any, source: object = "", arrays: Mapping[str, np.ndarray] | None = None
) -> Any:
    """A dataclass (or one of several: a union) from plain values of JSON and the arrays beside
    them. Raises StgaError naming the field, after `source`, unless each object has exactly the
    fields of its dataclass, of which LATER_FIELDS, with which a later version began, may be
    missing, and `validate` allows them."""
    try:
        value = _parsed(kind, values, "", arrays or {})
        validate(value)
    except StgaError as error:
        raise StgaError(f"{source}: {error}" if source else str(error)) from error
    return value


def _parsed(hint: Any, value: Any, where: str, arrays: Mapping[str, np.ndarray]) -> Any:
    """The value in the types of the hint, or as it is, for `validate` to name."""
    kinds = [kind for kind in alternatives(hint) if kind is not types.NoneType]
    classes: list[Any] = [kind for kind in kinds if dataclasses.is_dataclass(kind)]
    if isinstance(value, dict) and ARRAY in value and np.ndarray in kinds:
        return arrays.get(value[ARRAY]) if isinstance(value[ARRAY], str) else None
    if classes and (value is not None or len(kinds) == len(alternatives(hint))):
        chosen: Any = classes[0]
        if len(classes) > 1:
            names: dict[str, Any] = {each.__name__: each for each in classes}
            named = value.get(KIND) if isinstance(value, dict) else None
            if not isinstance(named, str) or named not in names:
                expected = f"one of {', '.join(names)}"
                raise StgaError(complaint(_joined(where, KIND), expected, named))
            chosen = names[named]
            value = {name: item for name, item in value.items() if name != KIND}
        hints = type_hints(chosen)
        known = set(hints)
        if isinstance(value, dict):  # a file of an earlier version
            known -= {*getattr(chosen, "LATER_FIELDS", ())} - value.keys()
        if not isinstance(value, dict) or value.keys() != known:
            differing = known ^ set(value if isinstance(value, dict) else ())
            fields = ", ".join(sorted(map(str, differing)))[:200]
            prefix = f"{where}: " if where else ""
            raise StgaError(f"{prefix}fields are missing or unknown ({fields})")
        paths = {name: _joined(where, name) for name in hints}
        return chosen(**{n: _parsed(hints[n], value[n], paths[n], arrays) for n in known})
    if isinstance(value, str) and Path in kinds and str not in kinds:
        try:
            return usable_path(value)
        except StgaError as error:
            raise StgaError(f"setting {where}: {error}") from error
    if isinstance(value, list):
        items = next((get_args(kind) for kind in kinds if get_origin(kind) is tuple), (Any,))
        return tuple(
            _parsed(items[0], item, _joined(where, str(row)), arrays)
            for row, item in enumerate(value)
        )
    mappings = [get_args(kind) for kind in kinds if get_origin(kind) in (dict, Mapping)]
    if isinstance(value, dict) and mappings:
        key_hint, item_hint = mappings[0]
        for key in value:
            if key_hint is int and not re.fullmatch(r"-?\d{1,15}", key, re.ASCII):
                raise StgaError(complaint(where, "whole numbers as names", key))
        return {
            key_hint(key): _parsed(item_hint, item, _joined(where, key), arrays)
            for key, item in value.items()
        }
    return value
