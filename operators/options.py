"""Fields of requests as Blender's properties: tooltip, limits and default are those of the command
line."""

import re
from collections.abc import Mapping
from math import inf
from pathlib import Path
from types import NoneType
from typing import Any

import bpy

from ..stga_addon.schema import MAX_COUNT, alternatives, type_hints
from .common import file_path, path_property

DEFAULT = re.compile(r" \(default:? ([^)]*)\)")
"""What a help says of the default, which Blender shows by itself, or for which 0 or nothing
stands."""


def option_property(
    kind: Any, name: str, label: str = "", labels: Mapping[str, str] | None = None, **more: Any
) -> Any:
    """A property for a field of a dataclass; 0 and "" stand for None.

    label: in place of the field's name; labels: in place of the names of its choices; more: what
    differs in Blender.
    """
    spec, (hint, *none) = kind.__dataclass_fields__[name], alternatives(type_hints(kind)[name])
    asked, is_optional = spec.metadata, none == [NoneType]
    help, default = DEFAULT.sub("", asked["help"]), DEFAULT.search(asked["help"])
    if is_optional and (default is not None or hint is not Path):
        help += f"; {'empty' if hint is Path else 0}: {'none' if default is None else default[1]}"
    about = {
        "name": label or name.replace("_", " ").title(),
        "description": help[0].upper() + help[1:],
        **more,
    }
    if hint is Path:
        return path_property(about.pop("name"), about.pop("description"), **about)
    if asked["offered"]:
        texts = asked["offered"]
        named = {
            choice: (labels or {}).get(choice, choice.replace("-", " ").title()) for choice in texts
        }
        items = [
            (choice, named[choice], text[0].upper() + text[1:]) for choice, text in texts.items()
        ]
        return bpy.props.EnumProperty(items=items, **about)
    if isinstance(spec.default, bool | int | float):
        about = {"default": spec.default, **about}
    if hint is bool:
        return bpy.props.BoolProperty(**about)
    low, high = 0 if is_optional else max(asked["minimum"], asked["above"]), asked["maximum"]
    limits = {
        **({"min": low} if low > -inf else {}),
        **({"max": min(high, MAX_COUNT)} if high < inf else {}),
    }
    return (bpy.props.IntProperty if hint is int else bpy.props.FloatProperty)(
        **{**limits, **about}
    )


def given_values(operator: Any, kind: Any, *names: str) -> dict[str, Any]:
    """Field -> value of an operator's properties, of those that are not left at None."""
    found = {}
    for name in names:
        value, (hint, *none) = getattr(operator, name), alternatives(type_hints(kind)[name])
        if none and not value:
            continue
        found[name] = file_path(value, name.replace("_", " ")).resolve() if hint is Path else value
    return found
