"""Writing of world-space splats as binary glTF with the extension KHR_gaussian_splatting."""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.splats import SH_C0, Splats
from ..capture.color import srgb_to_linear
from ..capture.glb import DTYPES, JSON_KIND, MAGIC, VERSION
from ..files import replacing

Json = dict[str, Any]
"""A glTF document, or a part of one."""
Arrays = dict[str, np.ndarray]
"""Arrays by their names in a file."""
EXTENSION = "KHR_gaussian_splatting"
GENERATOR = "STGA for Blender"
_BINARY_CHUNK = b"BIN\0"
# primitive mode; buffer target ARRAY_BUFFER
_POINTS = 0
VERTICES = 34962
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
COMPONENTS = {np.dtype(kind).name: number for number, kind in DTYPES.items()}


class Accessors:
    """Accessors and buffer views of a document, and the binary chunk that they describe."""

    def __init__(self) -> None:
        self.accessors = list[Json]()
        self.views = list[Json]()
        self.blocks = list[bytes]()
        self._size = 0

    @property
    def binary(self) -> bytes:
        """The chunk."""
        return b"".join(self.blocks)

    def add_view(self, data: bytes, **properties: Any) -> int:
        """Index of a buffer view that holds the bytes."""
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        self.views.append(view | properties)
        self.blocks.append(data + bytes(-len(data) % 4))
        self._size += len(self.blocks[-1])
        return len(self.views) - 1

    def add(self, array: np.ndarray, target: int | None = None, **properties: Any) -> int:
        """Index of an accessor of values (N,) or (N, 3, 4 or 16)."""
        view = self.add_view(little_endian(array), **({"target": target} if target else {}))
        return self.append({"bufferView": view} | accessor_of(array) | properties)

    def append(self, accessor: Json) -> int:
        """Index of an accessor."""
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def accessor_of(array: np.ndarray) -> Json:
    """Type and number of an accessor's values."""
    kind = TYPES[array.shape[1] if array.ndim > 1 else 1]
    return {"componentType": COMPONENTS[array.dtype.name], "type": kind, "count": len(array)}


def range_of(array: np.ndarray) -> Json:
    """Least and largest values of an accessor."""
    rows = array.reshape(len(array), -1)
    return {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}


def write_gltf(path: Path, world: Splats) -> None:
    """Write world-space splats as a .glb file with one mesh of points, atomically.

    Meters, y up as in the splats; rotations xyzw, standard deviations linear, opacity 0 to 1, every
    coefficient of the spherical harmonics an attribute. COLOR_0 is what a viewer without the
    extension shows.
    Source: Khronos, KHR_gaussian_splatting.
    """
    accessors = Accessors()
    more = {"POSITION": range_of(world.xyz), "COLOR_0": {"normalized": True}}
    attributes = {
        name: accessors.add(array, VERTICES, **more.get(name, {}))
        for name, array in _attributes(world).items()
    }
    splatting = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": attributes,
        "mode": _POINTS,
        "extensions": {EXTENSION: splatting},
    }
    document = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "Avatar"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors.accessors,
        "bufferViews": accessors.views,
        "buffers": [{"byteLength": len(accessors.binary)}],
    }
    with replacing(path) as partial:
        partial.write_bytes(glb_bytes(document, accessors.binary))


def _attributes(world: Splats) -> Arrays:
    """Semantic -> values, (N,) or (N, 3 or 4), each row a multiple of four bytes."""
    opacity = world.opacities()
    fallback = srgb_to_linear(np.clip(0.5 + SH_C0 * world.sh[:, 0], 0, 1))
    attributes = {
        "POSITION": world.xyz,
        "COLOR_0": np.round(np.column_stack([fallback, opacity]) * 255).astype(np.uint8),
        f"{EXTENSION}:ROTATION": world.unit_rotations()[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": world.scales(),
        f"{EXTENSION}:OPACITY": opacity,
    }
    for k in range(world.sh.shape[1]):
        degree = math.isqrt(k)
        name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"
        attributes[name] = world.sh[:, k]
    return attributes


def glb_bytes(document: Json, binary: bytes) -> bytes:
    """A .glb file of a document and its binary chunk."""
    text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        (
            MAGIC + struct.pack("<II", VERSION, size),
            struct.pack("<I", len(text)) + JSON_KIND + text,
            struct.pack("<I", len(binary)) + _BINARY_CHUNK + binary,
        )
    )


def little_endian(array: np.ndarray) -> bytes:
    """The values of an array as glTF stores them."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
