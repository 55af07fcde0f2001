"""Constants of Python as text of WGSL, GLSL and JavaScript."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


def _wgsl(name: str, value: float) -> str:
    if isinstance(value, int):
        return f"const {name}: u32 = {value}u;"
    return f"const {name}: f32 = {float(np.float32(value)).hex()}f;"


def _javascript(name: str, value: Any) -> str:
    numbers = np.asarray(value, float)
    texts = [repr(int(number) if number.is_integer() else number) for number in numbers.flat]
    text = f"[{', '.join(texts)}]" if numbers.ndim else texts[0]
    return f"export const {name} = {text};"


LANGUAGES: dict[str, Callable[[str, Any], str]] = {
    "wgsl": _wgsl,
    "glsl": lambda name, value: f"#define {name} {value!r}",
    "javascript": _javascript,
}
"""A name and a number -> the line that declares it; in JavaScript, also of a list of numbers."""


def printed_constants(values: Mapping[str, Any], language: str) -> str:
    """A line for each of the values, in one of LANGUAGES; whole numbers are counts in WGSL."""
    line = LANGUAGES[language]
    return "".join(f"{line(name, value)}\n" for name, value in values.items())
