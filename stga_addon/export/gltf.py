"""Writing of world-space splats as binary glTF with the extension KHR_gaussian_splatting."""

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.splats import SH_C0, Splats
from ..capture.color import srgb_to_linear
from ..files import replacing

EXTENSION = "KHR_gaussian_splatting"
GENERATOR = "STGA for Blender"
_MAGIC = b"glTF"
_VERSION = 2
_JSON_CHUNK = b"JSON"
_BINARY_CHUNK = b"BIN\0"
# primitive mode; buffer target ARRAY_BUFFER
_POINTS = 0
_VERTICES = 34962
_COMPONENTS = {
    "float32": {"componentType": 5126},
    "uint8": {"componentType": 5121, "normalized": True},
}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
DTYPES = {5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Component types of accessors."""


def write_gltf(path: Path, world: Splats) -> None:
    """Write world-space splats as a .glb file with one mesh of points, atomically.

    Meters, y up as in the splats; rotations xyzw, standard deviations linear, opacity 0 to 1, every
    coefficient of the spherical harmonics an attribute. COLOR_0 is what a viewer without the
    extension shows.
    Source: Khronos, KHR_gaussian_splatting.
    """
    attributes = _attributes(world)
    arrays = list(attributes.values())
    accessors, views = _accessors(arrays)
    # The first is the position.
    accessors[0] |= {"min": world.xyz.min(axis=0).tolist(), "max": world.xyz.max(axis=0).tolist()}
    splatting = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
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
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(array.nbytes for array in arrays)}],
    }
    binary = b"".join(little_endian(array) for array in arrays)
    with replacing(path) as partial:
        partial.write_bytes(glb_bytes(document, binary))


def _attributes(world: Splats) -> dict[str, np.ndarray]:
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


def _accessors(arrays: Sequence[np.ndarray]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Accessors of vertex attributes that lie in the buffer one after the other, and their buffer
    views."""
    accessors = list[dict[str, Any]]()
    views = list[dict[str, Any]]()
    offset = 0
    for array in arrays:
        kind = _TYPES[array.shape[1] if array.ndim > 1 else 1]
        accessor = {"bufferView": len(views), "count": len(array)}
        accessors.append(accessor | _COMPONENTS[array.dtype.name] | {"type": kind})
        view = {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes}
        views.append(view | {"target": _VERTICES})
        offset += array.nbytes
    return accessors, views


def glb_bytes(document: dict[str, Any], binary: bytes) -> bytes:
    """A .glb file of a document and its binary chunk."""
    text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        (
            _MAGIC + struct.pack("<II", _VERSION, size),
            struct.pack("<I", len(text)) + _JSON_CHUNK + text,
            struct.pack("<I", len(binary)) + _BINARY_CHUNK + binary,
        )
    )


def little_endian(array: np.ndarray) -> bytes:
    """The values of an array as glTF stores them."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
