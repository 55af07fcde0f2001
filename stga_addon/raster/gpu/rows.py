"""Rows of tables between steps: columns are read, rows taken in another order, columns of some rows
written."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .device import Device, Recording

PACKED = "pair_gradients"
"""A buffer that is in use within an iteration only."""
NUMBERS = "row_numbers"


@dataclass(frozen=True)
class Column:
    """Neighboring columns of a table (N, stride) on the device: words from `first` on that are an
    array (N, *shape)."""

    table: Any
    stride: int
    first: int
    shape: tuple[int, ...] = ()
    dtype: Any = np.float32

    @property
    def width(self) -> int:
        return math.prod(self.shape)


@dataclass(frozen=True)
class _Move:
    """Rows on their way from tables to the buffer `packed`, or back; numbers: a buffer of theirs,
    None for the first ones."""

    work: Recording
    packed: Any
    rows: int
    numbers: Any = None

    def record(self, kernel: str, column: Column, at: int = 0, alike: bool = False) -> None:
        """Record a kernel of rows.wgsl; at: the word from which on the column is packed; alike: one
        value is, for all rows."""
        device = self.work.device
        part = device.uniform(
            "Part",
            f"part {len(self.work.commands)}",
            stride=column.stride,
            first=column.first,
            width=column.width,
            rows=self.rows,
            at=at,
            listed=self.numbers is not None,
            alike=alike,
        )
        tables = {"part": part, "table": column.table, "packed": self.packed}
        tables["numbers"] = self.numbers or device.buffer(NUMBERS, 0)
        self.work.dispatch(f"rows.{kernel}", self.rows * column.width, tables)


def read_columns(
    device: Device, columns: Mapping[str, Column], rows: int | np.ndarray
) -> dict[str, np.ndarray]:
    """Columns of rows, (M,) numbers or so many of the first, copied to host memory at once."""
    count = rows if isinstance(rows, int) else len(rows)
    numbers = None if isinstance(rows, int) else device.upload(NUMBERS, rows.astype(np.uint32))
    starts = {}
    total = 0
    for name, column in columns.items():
        starts[name] = total
        total += count * column.width
    packed = device.buffer(PACKED, total)
    with device.record() as work:
        for name, column in columns.items():
            _Move(work, packed, count, numbers).record("gather", column, starts[name])
    words = device.read(packed, (total,), np.uint32)
    found = {}
    for name, column in columns.items():
        of_column = words[starts[name] :][: count * column.width]
        found[name] = of_column.view(column.dtype).reshape(count, *column.shape)
    return found


def write_columns(
    device: Device, rows: np.ndarray, values: Sequence[tuple[Column, np.ndarray | float]]
) -> None:
    """Write to rows (M,) of columns: values (M, …) or a number, one after the other."""
    flat = [np.asarray(value, column.dtype).ravel().view(np.uint32) for column, value in values]
    packed = device.upload(PACKED, np.concatenate(flat))
    numbers = device.upload(NUMBERS, rows.astype(np.uint32))
    at = 0
    with device.record() as work:
        for (column, value), words in zip(values, flat, strict=True):
            move = _Move(work, packed, len(rows), numbers)
            move.record("scatter", column, at, alike=np.ndim(value) == 0)
            at += len(words)


def take_rows(
    device: Device, rows: np.ndarray, tables: Mapping[str, tuple[Any, int]]
) -> dict[str, Any]:
    """Put these rows (M,), in this order, in place of all rows; tables: the device's buffers by
    name, and words per row. Returns the buffers that hold them now."""
    count = len(rows)
    numbers = device.upload(NUMBERS, rows.astype(np.uint32))
    packed = device.buffer(PACKED, count * max(stride for _, stride in tables.values()))
    taken = {}
    with device.record() as work:
        for name, (table, stride) in tables.items():
            whole = Column(table, stride, 0, (stride,))
            _Move(work, packed, count, numbers).record("gather", whole)
            taken[name] = device.buffer(name, count * stride)
            if count:
                work.copy(packed, taken[name], count * stride)
    return taken
