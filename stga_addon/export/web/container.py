"""The container of web data files: a JSON header and arrays as byte planes, gzipped (docs/formats.md)."""

import gzip
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

MAGIC = b"STGA"
FORMAT, VERSION = "stga-web", 1
MAX_PLANES = 4
MAX_STEPS = 1 << 31
"""Largest number of steps from zero: what four planes hold."""
GZIP_LEVEL = 7
"""Level 9 takes six times as long and makes the demo's page half a percent smaller."""


@dataclass(frozen=True)
class FixedPoint:
    """Real numbers to be stored as multiples of `step`, with an error of at most half of it."""

    values: np.ndarray
    step: float


def pack(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray | FixedPoint]) -> bytes:
    """A data file: `header` and `arrays`, which are integers, float32 or `FixedPoint`.

    Integers are stored exactly. Equal contents give equal bytes. Raises ValueError where a value is not finite, or too
    many steps from zero.
    """
    entries: dict[str, Any] = {}
    blocks = []
    for name, array in arrays.items():
        entries[name], block = _entry(name, array)
        blocks.append(block)
    complete = {"format": FORMAT, "version": VERSION, **header, "arrays": entries}
    text = json.dumps(complete, ensure_ascii=False, allow_nan=False).encode("utf-8")
    raw = b"".join((MAGIC, VERSION.to_bytes(4, "little"), len(text).to_bytes(4, "little"), text, *blocks))
    return gzip.compress(raw, GZIP_LEVEL, mtime=0)


def _entry(name: str, array: np.ndarray | FixedPoint) -> tuple[dict[str, Any], bytes]:
    """Header entry and stored bytes of an array."""
    if isinstance(array, FixedPoint):
        steps = np.rint(np.asarray(array.values, np.float64) / array.step)
        if not (np.abs(steps) < MAX_STEPS).all():
            raise ValueError(f"{name} holds a value that is not finite, or beyond {MAX_STEPS * array.step:g}")
        planes, low, block = _planes(steps.astype(np.int64))
        return {"type": "fixed", "shape": list(steps.shape), "planes": planes, "low": low, "step": array.step}, block
    if array.dtype.kind in "iub":
        planes, low, block = _planes(array.astype(np.int64))
        return {"type": "integer", "shape": list(array.shape), "planes": planes, "low": low}, block
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds a value that is not finite")
    return {"type": "float32", "shape": list(array.shape)}, np.ascontiguousarray(array, "<f4").tobytes()


def _planes(integers: np.ndarray) -> tuple[int, int, bytes]:
    """(count, lowest value, bytes) of integers above their lowest: byte planes, least significant first.

    Within a plane the last axis varies slowest, so that equal quantities lie side by side: gzip gains a fifth.
    """
    low = int(integers.min()) if integers.size else 0
    above = np.ascontiguousarray(np.moveaxis(integers - low, -1, 0)).ravel()
    largest = int(above.max()) if above.size else 0
    count = max(1, (largest.bit_length() + 7) // 8)
    if count > MAX_PLANES:
        raise ValueError(f"values from {low} to {low + largest} do not fit {MAX_PLANES} bytes")
    return count, low, b"".join(((above >> 8 * plane) & 255).astype(np.uint8).tobytes() for plane in range(count))
