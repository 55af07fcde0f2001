"""Binary glTF: its chunks, and the values of its accessors."""

import struct
from typing import Any

import numpy as np

from ..errors import shorten
from ..files import parse_json

Json = dict[str, Any]
"""JSON object of a glTF document."""
MAGIC = b"glTF"
"""First bytes of a GLB, glTF's binary form."""
VERSION = 2
"""Version of glTF in the header of a GLB."""
JSON_KIND = b"JSON"
"""Type of a GLB's first chunk, which holds the document."""

HEADER_BYTES = 20
"""Bytes of the file's header and of that of its first chunk."""
CHUNK_HEADER_BYTES = 8
"""Bytes of the header of any later chunk."""
DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Component type of a GLB's accessor -> NumPy's name of it."""
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Type of a GLB's accessor -> numbers of an element."""
MIN_NUMBERS_ALLOWANCE = 1 << 20
"""Numbers that the accessors of any file may have together."""
MAX_NUMBERS_PER_BYTE = 8
"""Numbers that they may have for each byte of a larger one."""
UNREADABLE = LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError
"""Exceptions that reading a damaged document raises."""


def glb_chunks(data: bytes) -> tuple[Json, bytes]:
    """The document and the binary chunk of a .glb file; the chunk is empty where there is none.
    Raises ValueError where it is not binary glTF 2.0. Source: Khronos, glTF 2.0, section 4.4."""
    if len(data) < HEADER_BYTES:
        raise ValueError("ends within its header")
    magic, version, _, length, kind = struct.unpack_from("<4sIII4s", data)
    if (magic, version, kind) != (MAGIC, VERSION, JSON_KIND):
        raise ValueError("expected binary glTF 2.0, with a JSON chunk at its beginning")
    if length > len(data) - HEADER_BYTES:
        raise ValueError("its JSON chunk reaches beyond the file")
    document = parse_json(data[HEADER_BYTES : HEADER_BYTES + length])
    if not isinstance(document, dict):
        raise ValueError("its JSON chunk holds no object")
    rest = data[HEADER_BYTES + length :]
    size = struct.unpack_from("<I", rest)[0] if len(rest) >= CHUNK_HEADER_BYTES else 0
    return document, rest[CHUNK_HEADER_BYTES : CHUNK_HEADER_BYTES + size]


def allowed_numbers(size: int) -> int:
    """Numbers that the joined mesh of a GLB of `size` bytes may hold. Accessors without data may
    promise any number of zeros, and nodes repeat meshes; sparse morph targets of a real head reach
    4 a byte."""
    return MIN_NUMBERS_ALLOWANCE + MAX_NUMBERS_PER_BYTE * size


def count_of(accessor: Json) -> int:
    """Raises ValueError where an accessor holds no elements."""
    count = accessor["count"]
    if type(count) is not int or count < 1:
        raise ValueError(f"an accessor of {shorten(count)} elements")
    return count


def accessor_values(
    document: Json, data: bytes, number: int, rows: int | None = None, width: int | None = None
) -> np.ndarray:
    """Values (rows, width) of an accessor, float64, sparse ones applied; of its own shape where
    none is given. Raises one of UNREADABLE where it is damaged."""
    accessor = document["accessors"][number]
    shape = count_of(accessor), WIDTHS[accessor["type"]]
    if shape != (rows or shape[0], width or shape[1]):
        raise ValueError("an accessor is of another type or length than its use")
    if shape[0] * shape[1] > allowed_numbers(len(data)):
        raise ValueError("an accessor counts more than the file can hold")
    component = accessor["componentType"]
    values = np.zeros(shape)
    if "bufferView" in accessor:
        values = _view(document, data, accessor, component, shape)
    sparse = accessor.get("sparse")
    if sparse:
        changed = count_of(sparse)
        indices = sparse["indices"]
        places = _view(document, data, indices, indices["componentType"], (changed, 1))[:, 0]
        found = _view(document, data, sparse["values"], component, (changed, shape[1]))
        values[places.astype(np.int64)] = found
    if accessor.get("normalized"):
        values = np.maximum(values / np.iinfo(DTYPES[component]).max, -1)
    return values


def _view(
    document: Json, data: bytes, source: Json, component: int, shape: tuple[int, int]
) -> np.ndarray:
    """A buffer view's values, as float64 copies of this shape."""
    view = document["bufferViews"][source["bufferView"]]
    dtype = np.dtype(DTYPES[component])
    if view.get("buffer", 0) != 0:
        raise ValueError("expected one buffer")
    start = int(view.get("byteOffset", 0)) + int(source.get("byteOffset", 0))
    size = dtype.itemsize * shape[1]
    stride = int(view.get("byteStride", size))
    if start < 0 or stride < size or start + stride * (shape[0] - 1) + size > len(data):
        raise ValueError("an accessor reaches beyond the file")
    return np.ndarray(shape, dtype, data, start, (stride, dtype.itemsize)).astype(np.float64)
