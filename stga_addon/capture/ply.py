"""Reading of PLY files: any elements and properties, binary or ASCII."""

import re
import struct
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..errors import StgaError, shorten
from ..files import CHANGED_LINE_ENDS, converted, line_ends_changed

MAX_HEADER_BYTES = 1 << 16
"""Bytes within which the header of a file must end."""

MAX_LINES = 1 << 23
"""Lines of an ASCII file, each of which becomes a Python object."""
MAX_UNEVEN_ROWS = 1 << 23
"""Rows of lists of different lengths, which are walked through one by one."""
GATHERED_ROWS = 1 << 16
"""Rows of such an element that are unpacked at once."""
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True)
class Lists:
    """A list property of N rows: `lengths` (N,), and the `values` of all rows in order."""

    lengths: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Element:
    """An element of a header.

    scalars  property -> numpy's type with byte order, of all but lists
    lists    list property -> types of its length and of its values
    order    names of all properties as they follow each other in a row
    """

    name: str
    count: int
    scalars: dict[str, str] = field(default_factory=dict)
    lists: dict[str, tuple[str, str]] = field(default_factory=dict)
    order: list[str] = field(default_factory=list)

    @property
    def row_bytes(self) -> int:
        """The least that a row takes."""
        kinds = [*self.scalars.values(), *(length for length, _ in self.lists.values())]
        return sum(np.dtype(kind).itemsize for kind in kinds)


@dataclass(frozen=True)
class Rows:
    """An element's rows: `scalars` (N,), a field for each property; `lists` by property."""

    scalars: np.ndarray
    lists: dict[str, Lists] = field(default_factory=dict)


def ply_header(path: Path, data: bytes) -> tuple[list[Element], str, int]:
    """The elements of a PLY file, "<", ">" or, for ASCII, "=", and where its rows begin. Raises
    StgaError naming the file. Source: Greg Turk, The PLY Polygon File Format."""
    start = data[:MAX_HEADER_BYTES]
    is_old_mac = re.match(rb"ply[ \t]*\r(?!\n)", start) is not None
    ending = rb"\rend_header[ \t]*\r" if is_old_mac else rb"\nend_header[ \t\r]*\n"
    end = re.search(ending, start)
    if not start.startswith(b"ply") or end is None:
        raise StgaError(f"{path}: is not a PLY file (no complete header)")
    order = ""
    elements = dict[str, Element]()
    try:
        for line in start[: end.start()].decode("latin-1").splitlines():
            element = elements[next(reversed(elements))] if elements else None
            match line.split():
                case ["format", name, _]:
                    order = _BYTE_ORDERS[name]
                case ["element", name, count] if name not in elements and int(count) >= 0:
                    elements[name] = Element(name, int(count))
                case ["property", kind, name] if element is not None and name not in element.order:
                    element.scalars[name] = order + _TYPES[kind]
                    element.order.append(name)
                case ["property", "list", length, kind, name] if (
                    element and name not in element.order and _TYPES[length][0] in "iu"
                ):
                    element.lists[name] = order + _TYPES[length], order + _TYPES[kind]
                    element.order.append(name)
                case ["ply"] | ["comment" | "obj_info", *_] | []:
                    pass
                case _:
                    raise ValueError(line)
    except (ValueError, KeyError) as error:
        raise StgaError(
            f"{path}: PLY header cannot be understood ({shorten(str(error))})"
        ) from error
    if not order:
        raise StgaError(f"{path}: PLY header cannot be understood (no format)")
    return list(elements.values()), order, end.end()


def ply_rows(path: Path, data: bytes, names: Sequence[str]) -> dict[str, Rows]:
    """The rows of the named elements that the contents of a PLY file have, in file order. Raises
    StgaError where it is malformed or shorter than its header states; nothing is allocated before
    the file is known to hold it."""
    elements, order, position = ply_header(path, data)
    lines: list[bytes] = []
    if order == "=":
        if data.count(b"\n") + data.count(b"\r") > MAX_LINES:
            raise StgaError(f"{path}: has more than {MAX_LINES} lines; expected a binary PLY")
        lines = [line for line in re.split(rb"[\r\n]+", data[position:]) if line.strip()]
        position = 0
    last = max((n for n, element in enumerate(elements) if element.name in names), default=-1)
    found: dict[str, Rows] = {}
    try:
        for element in elements[: last + 1]:
            if order == "=":
                _require(path, element, len(lines) - position)
                end = position + element.count
                rows = _ascii_rows(element, lines[position:end])
            else:
                _require(path, element, (len(data) - position) // max(element.row_bytes, 1))
                rows, end = _binary_rows(element, data, position)
            if element.name in names:
                found[element.name] = rows
            position = end
    except (ValueError, struct.error, OverflowError) as error:
        changed = order != "=" and line_ends_changed(data)
        problem = CHANGED_LINE_ENDS if changed else f"is not a readable PLY ({error})"
        raise StgaError(f"{path}: {problem}") from error
    return found


def _require(path: Path, element: Element, most: int) -> None:
    """Raise StgaError where the file has not as many rows as the header states."""
    if element.count > most:
        raise StgaError(
            f"{path}: is truncated: it cannot hold {element.count} rows of {shorten(element.name)}"
        )


def _binary_rows(element: Element, data: bytes, position: int) -> tuple[Rows, int]:
    """The rows that begin at a position, and where they end. Raises ValueError, struct.error."""
    even = _even_rows(element, data, position)
    if even is not None:
        return even
    if element.count > MAX_UNEVEN_ROWS:
        name = shorten(element.name)
        expected = f"expected at most {MAX_UNEVEN_ROWS}, or lists of one length"
        raise ValueError(
            f"{element.count} rows of {name} hold lists of different lengths; {expected}"
        )
    lengths, end = _lengths(element, data, position)
    return _gathered_rows(element, data, position, lengths), end


def _lengths(element: Element, data: bytes, position: int) -> tuple[dict[str, np.ndarray], int]:
    """Lengths (N,) by list property, and where the rows end. Raises ValueError, struct.error."""
    steps = []
    gap = 0
    for name in element.order:
        if name in element.scalars:
            gap += np.dtype(element.scalars[name]).itemsize
            continue
        length, kind = (np.dtype(each) for each in element.lists[name])
        layout = struct.Struct(f"{length.str[0].replace('|', '=')}{length.char}")
        numbers = array("q")
        steps.append((gap, layout.unpack_from, layout.size, kind.itemsize, numbers))
        gap = 0
    end = position
    for _ in range(element.count):
        for before, unpack, size, item, numbers in steps:
            end += before
            (number,) = unpack(data, end)
            end += size + number * item
            numbers.append(number)
        end += gap
    found = (np.frombuffer(numbers, np.int64) for *_, numbers in steps)
    lengths = dict(zip(element.lists, found, strict=True))
    if any((each < 0).any() for each in lengths.values()):
        raise ValueError("a list of negative length")
    if end > len(data):
        raise ValueError(f"the last row of {shorten(element.name)} is cut off")
    return lengths, end


def _gathered_rows(
    element: Element, data: bytes, position: int, lengths: Mapping[str, np.ndarray]
) -> Rows:
    """The rows that begin at a position, with lists of these lengths (N,)."""
    table = np.empty(element.count, list(element.scalars.items()))
    values = {name: [np.empty(0, kind)] for name, (_, kind) in element.lists.items()}
    for first in range(0, element.count, GATHERED_ROWS):
        rows = slice(first, first + GATHERED_ROWS)
        sizes = np.full(len(table[rows]), element.row_bytes)
        for name, each in lengths.items():
            sizes += each[rows] * values[name][0].itemsize
        raw = np.frombuffer(data, np.uint8, sizes.sum(), position)
        place = np.cumsum(sizes) - sizes  # of the next property in each row
        for name in element.order:
            if name in element.scalars:
                kind = np.dtype(element.scalars[name])
                column = raw[place[:, None] + np.arange(kind.itemsize)]
                table[name][rows] = column.view(kind)[:, 0]
                place += kind.itemsize
                continue
            place += np.dtype(element.lists[name][0]).itemsize
            end = place + lengths[name][rows] * values[name][0].itemsize
            is_filled = end > place
            change = np.zeros(len(raw) + 1, np.int8)
            change[place[is_filled]] = 1
            change[end[is_filled]] = -1
            is_inside = np.cumsum(change, out=change)[:-1].view(bool)
            values[name].append(raw[is_inside].view(values[name][0].dtype))
            place = end
        position += len(raw)
    lists = {name: Lists(each, np.concatenate(values[name])) for name, each in lengths.items()}
    return Rows(table, lists)


def _even_rows(element: Element, data: bytes, position: int) -> tuple[Rows, int] | None:
    """The rows where all lists, if any, are as long as those of the first row; None where they are
    not."""
    dtype = list[tuple[str, str, int]]()
    row = position
    for name in element.order:
        if name in element.scalars:
            dtype.append((name, element.scalars[name], 1))
            row += np.dtype(element.scalars[name]).itemsize
            continue
        length, kind = element.lists[name]
        start = np.frombuffer(data[row : row + np.dtype(length).itemsize], length)
        if not len(start) or not 0 <= start[0] <= len(data):
            return None
        dtype += [(f"{name} length", length, 1), (name, kind, int(start[0]))]
        row += np.dtype(length).itemsize + int(start[0]) * np.dtype(kind).itemsize
    whole = np.dtype([(n, k) if size == 1 else (n, k, (size,)) for n, k, size in dtype])
    end = position + element.count * whole.itemsize
    if end > len(data):
        return None
    table = np.zeros(element.count, whole)
    if whole.itemsize:
        table = np.frombuffer(data, whole, element.count, position)
    lists = {}
    for name in element.lists:
        lengths = table[f"{name} length"]
        if (lengths != lengths[:1]).any():
            return None
        lists[name] = Lists(lengths.astype(np.int64), table[name].reshape(-1))
    scalars = table[list(element.scalars)] if element.scalars else np.zeros(element.count, [])
    return Rows(scalars, lists), end


def _ascii_rows(element: Element, lines: Sequence[bytes]) -> Rows:
    """The rows of lines of text, a row a line. Raises ValueError."""
    if not element.lists and lines:
        table = np.loadtxt(lines, np.float64, None, ndmin=2)
        if table.shape[1] != len(element.scalars):
            raise ValueError(f"has {table.shape[1]} numbers a row, expected {len(element.scalars)}")
        return _as_rows(element, list(table.T), [[]] * len(element.order))

    def rows() -> Iterator[Callable[[int], Sequence[float]]]:
        words: list[bytes] = []
        place = 0

        def take(count: int) -> Sequence[float]:
            nonlocal place
            start = place
            place += count
            return [float(word) for word in words[start:place]]

        for line in lines:
            words = line.split()
            place = 0
            yield take
            if place != len(words):
                raise ValueError(
                    f"a row of {shorten(element.name)} has {len(words)} numbers, expected {place}"
                )

    values = [list[float]() for _ in element.order]
    lengths = [list[int]() for _ in element.order]
    for take in rows():
        for column, name in enumerate(element.order):
            if name in element.scalars:
                values[column] += take(1)
                continue
            length = int(sum(take(1)))
            if length < 0:
                raise ValueError("a list of negative length")
            values[column] += take(length)
            lengths[column].append(length)
    return _as_rows(element, values, lengths)


def _as_rows(
    element: Element, values: Sequence[ArrayLike], lengths: Sequence[Sequence[int]]
) -> Rows:
    """The rows of columns of numbers, in the order of the element's properties."""
    table = np.empty(element.count, list(element.scalars.items()))
    lists = {}
    for name, numbers, sizes in zip(element.order, values, lengths, strict=True):
        if name in element.scalars:
            table[name] = converted(numbers, element.scalars[name])
        else:
            entries = converted(numbers, element.lists[name][1])
            lists[name] = Lists(np.array(sizes, np.int64), entries)
    return Rows(table, lists)
