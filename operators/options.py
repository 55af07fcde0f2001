"""Properties of operators and panels: paths, and fields of requests, whose tooltip, limits and
default are those of the command line."""

import re
from collections.abc import Collection, Mapping
from math import inf
from pathlib import Path
from types import NoneType
from typing import Any

import bpy

from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.schema import MAX_COUNT, alternatives, type_hints

ONCE = {"SKIP_SAVE"}
"""Options of a property that holds for one call: Blender does not remember it for the next."""
FACTOR = {"min": 0.0, "max": 1.0, "subtype": "FACTOR"}
"""Limits of a number from 0 to 1 that is drawn as a slider."""
DEFAULT = re.compile(r" \(default:? ([^)]*)\)")
"""Statement of the default in a help, which Blender shows by itself, or for which 0 or nothing
stands."""


def _maker(make: Any) -> Any:
    return lambda name, description, **more: make(name=name, description=description, **more)


boolean = _maker(bpy.props.BoolProperty)
integer = _maker(bpy.props.IntProperty)
number = _maker(bpy.props.FloatProperty)
text = _maker(bpy.props.StringProperty)


def choice(name: str, description: str, *items: tuple[str, str, str], **more: Any) -> Any:
    """items: identifier, label and description of each choice."""
    return bpy.props.EnumProperty(name=name, description=description, items=items, **more)


def path(
    name: str, description: str, subtype: str = "FILE_PATH", options: Any = (), **more: Any
) -> Any:
    """A path, which may begin with "//"."""
    options = {*PATH_OPTIONS, *options}
    return text(name, description, subtype=subtype, options=options, **more)


def file_filter(*suffixes: str) -> Any:
    """The files that a file browser shows."""
    patterns = ";".join(f"*{suffix}" for suffix in suffixes)
    return bpy.props.StringProperty(default=patterns, options={"HIDDEN"})


def flame() -> Any:
    """FLAME model of an import operator."""
    purpose = "for captures and motions tracked with FLAME; empty: that of the preferences"
    return path("FLAME Model", f"FLAME model file (.pkl or .npz), {purpose}", options=ONCE)


def python(work: str, options: Collection[str] = ONCE) -> Any:
    """The interpreter that does a work."""
    about = f"Python interpreter that {work}; empty: that of the preferences, or Blender's own"
    return text("Python", about, subtype="FILE_PATH", options=options)


def field(
    kind: Any, name: str, label: str = "", labels: Mapping[str, str] | None = None, **more: Any
) -> Any:
    """A property for a field of a dataclass; 0 and "" stand for None.

    label: in place of the field's name; labels: in place of the names of its choices; more: what
    differs in Blender.
    """
    spec = kind.__dataclass_fields__[name]
    (hint, *none) = alternatives(type_hints(kind)[name])
    asked = spec.metadata
    is_optional = none == [NoneType]
    help = DEFAULT.sub("", asked["help"])
    default = DEFAULT.search(asked["help"])
    if is_optional and (default is not None or hint is not Path):
        help += f"; {'empty' if hint is Path else 0}: {'none' if default is None else default[1]}"
    label = label or name.replace("_", " ").title()
    about = {"name": label, "description": help[0].upper() + help[1:], **more}
    if hint is Path:
        return path(about.pop("name"), about.pop("description"), **about)
    if asked["offered"]:
        named = {each: each.replace("-", " ").title() for each in asked["offered"]}
        named |= labels or {}
        items = [
            (choice, named[choice], text[0].upper() + text[1:])
            for choice, text in asked["offered"].items()
        ]
        return bpy.props.EnumProperty(items=items, **about)
    if isinstance(spec.default, bool | int | float):
        about = {"default": spec.default, **about}
    if hint is bool:
        return bpy.props.BoolProperty(**about)
    low = 0 if is_optional else max(asked["minimum"], asked["above"])
    high = asked["maximum"]
    limits = {"min": low} if low > -inf else {}
    limits |= {"max": min(high, MAX_COUNT)} if high < inf else {}
    make = bpy.props.IntProperty if hint is int else bpy.props.FloatProperty
    return make(**{**limits, **about})
