"""Validation of dataclasses whose fields state their allowed values."""

import dataclasses
import math
from collections.abc import Collection, Mapping
from dataclasses import field
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from .errors import StgaError, shorten

MAX_COUNT = (1 << 31) - 1
"""Largest whole number that kernels can count to."""


def setting(
    default: Any,
    minimum: float = -math.inf,
    maximum: float = math.inf,
    above: float = -math.inf,
    choices: Collection[str] | None = None,
) -> Any:
    """A dataclass field with its allowed values, for `validate`; the bounds hold for each number of a tuple.

    minimum, maximum  inclusive; above: exclusive lower bound
    """
    return field(default=default, metadata={"minimum": minimum, "maximum": maximum, "above": above, "choices": choices})


def build(kind: Any, values: Any, where: str) -> Any:
    """A dataclass from plain values, nested ones included; lists become tuples.

    Raises StgaError beginning with `where` unless `values` has exactly its fields.
    """
    hints = get_type_hints(kind)
    if not isinstance(values, dict) or values.keys() != hints.keys():
        names = hints.keys() ^ (values.keys() if isinstance(values, dict) else {})
        raise StgaError(f"{where}: fields are missing or unknown ({', '.join(sorted(map(str, names)))[:200]})")
    parts = {
        name: build(hint, values[name], f"{where}.{name}") if dataclasses.is_dataclass(hint) else _frozen(values[name])
        for name, hint in hints.items()
    }
    return kind(**parts)


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


def validate_fields(part: Any, prefix: str = "") -> None:
    """Raise StgaError naming the first field of a dataclass that is of another type or outside its allowed values."""
    hints = get_type_hints(type(part))
    for spec in dataclasses.fields(part):
        value, hint = getattr(part, spec.name), hints[spec.name]
        expected = _expected(value, hint, spec.metadata)
        if expected is not None:
            raise StgaError(complaint(prefix + spec.name, expected, value))
        if dataclasses.is_dataclass(hint):
            validate_fields(value, f"{prefix}{spec.name}.")


def complaint(name: str, expected: str, value: Any) -> str:
    """The message for a setting with a value that is not allowed."""
    return f"setting {name}: expected {expected}, got {shorten(value)}"


def _expected(value: Any, hint: Any, limits: Mapping[str, Any]) -> str | None:
    """What `value` should have been by its type and its limits; None where it is allowed."""
    kinds = [kind for kind in get_args(hint) if kind is not NoneType] if NoneType in get_args(hint) else [hint]
    kind = kinds[0]
    if value is None and NoneType in get_args(hint):
        return None
    if get_origin(kind) is tuple:
        return _expected_items(value, get_args(kind), limits)
    if kind in (int, float):
        return _expected_number(value, kind, limits)
    choices = limits.get("choices")
    if kind is str and choices is not None:
        return None if isinstance(value, str) and value in choices else f"one of {', '.join(choices)}"
    plain = get_origin(kind) or kind
    if not isinstance(value, plain):
        return {str: "a text", bool: "True or False"}.get(plain, f"an object of {plain.__name__}")
    if plain is Mapping and not all(isinstance(text, str) for pair in value.items() for text in pair):
        return "texts by name"
    return None


def _expected_items(value: Any, hints: tuple[Any, ...], limits: Mapping[str, Any]) -> str | None:
    size = None if hints[-1] is Ellipsis else len(hints)
    if not isinstance(value, tuple) or size not in (None, len(value)):
        return "a tuple" if size is None else f"a tuple of {size}"
    found = (_expected(item, hints[0], limits) for item in value)
    return next((f"a tuple, each item {text}" for text in found if text is not None), None)


def _expected_number(value: Any, kind: type, limits: Mapping[str, Any]) -> str | None:
    low, high, above = (limits.get(name, end) for name, end in _UNBOUNDED.items())
    if kind is int:
        fits = isinstance(value, int)
    else:
        fits = isinstance(value, float) and math.isfinite(value)
        fits = fits or (isinstance(value, int) and abs(value) <= MAX_COUNT)
    if fits and not isinstance(value, bool) and low <= value <= high and value > above:
        return None
    bounds = [f"above {above}"] if above > -math.inf else [f"from {low}"] if low > -math.inf else []
    bounds += [f"up to {high}"] if high < math.inf else []
    return " ".join(["a whole number" if kind is int else "a finite number", *bounds])


_UNBOUNDED = {"minimum": -math.inf, "maximum": math.inf, "above": -math.inf}
