"""Constants of Python as text of WGSL, GLSL and JavaScript."""

from collections.abc import Callable, Mapping

import numpy as np


def _wgsl(name: str, value: float) -> str:
    if isinstance(value, int):
        return f"const {name}: u32 = {value}u;"
    return f"const {name}: f32 = {float(np.float32(value)).hex()}f;"


def _javascript(name: str, value: float) -> str:
    text = int(value) if float(value).is_integer() else float(value)
    return f"export const {name} = {text!r};"


LANGUAGES: dict[str, Callable[[str, float], str]] = {
    "wgsl": _wgsl,
    "glsl": lambda name, value: f"#define {name} {value!r}",
    "javascript": _javascript,
}
"""A name and a number -> the line that declares it."""


def printed_constants(values: Mapping[str, float], language: str) -> str:
    """A line for each of the numbers, in one of LANGUAGES; whole numbers are counts in WGSL."""
    line = LANGUAGES[language]
    return "".join(f"{line(name, value)}\n" for name, value in values.items())
