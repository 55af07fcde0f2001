"""Writing of world-space splats as binary glTF with the extension KHR_gaussian_splatting."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.splats import SH_C0, Splats
from ..capture.color import srgb_to_linear
from ..files import replacing

EXTENSION = "KHR_gaussian_splatting"
_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", 2, b"JSON", b"BIN\0"
_POINTS, _VERTICES = 0, 34962  # primitive mode; buffer target ARRAY_BUFFER
_COMPONENTS = {"float32": 5126, "uint8": 5121}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gltf(path: Path, world: Splats) -> None:
    """Write world-space splats as a .glb file with one mesh of points, atomically.

    Meters, y up as in the splats; rotations xyzw, standard deviations linear, opacity 0 to 1, every coefficient of the
    spherical harmonics an attribute. COLOR_0 is what a viewer without the extension shows.
    Source: Khronos, KHR_gaussian_splatting.
    """
    attributes = _attributes(world)
    views, accessors, offset = [], [], 0
    for name, array in attributes.items():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": _VERTICES})
        accessors.append(_accessor(len(views) - 1, name, array))
        offset += array.nbytes
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
        "asset": {"version": "2.0", "generator": "STGA for Blender"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "Avatar"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    _write_glb(path, document, list(attributes.values()))


def _attributes(world: Splats) -> dict[str, np.ndarray]:
    """Semantic -> values, (N,) or (N, 3 or 4), each row a multiple of four bytes."""
    opacity = world.opacities()
    attributes = {
        "POSITION": world.xyz,
        "COLOR_0": _fallback_color(world.sh[:, 0], opacity),
        f"{EXTENSION}:ROTATION": world.unit_rotations()[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": world.scales(),
        f"{EXTENSION}:OPACITY": opacity,
    }
    for degree in range(world.sh_degree + 1):
        for index in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"] = world.sh[:, degree**2 + index]
    return {name: np.ascontiguousarray(array) for name, array in attributes.items()}


def _fallback_color(base: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """(N, 4) uint8: linear red, green, blue of the degree-0 coefficients (N, 3), and the opacity (N,)."""
    color = np.clip(0.5 + SH_C0 * base, 0, 1)
    return np.asarray(np.round(np.column_stack([srgb_to_linear(color), opacity]) * 255), np.uint8)


def _accessor(view: int, name: str, array: np.ndarray) -> dict[str, Any]:
    accessor: dict[str, Any] = {
        "bufferView": view,
        "componentType": _COMPONENTS[array.dtype.name],
        "count": len(array),
        "type": _TYPES[array.shape[1] if array.ndim > 1 else 1],
    }
    if array.dtype == np.uint8:
        accessor["normalized"] = True
    if name == "POSITION":
        accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
    return accessor


def _write_glb(path: Path, document: dict[str, Any], arrays: list[np.ndarray]) -> None:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = sum(array.nbytes for array in arrays)
    with replacing(path) as partial, partial.open("wb") as out:
        out.write(_MAGIC + struct.pack("<II", _VERSION, 12 + 8 + len(text) + 8 + size))
        out.write(struct.pack("<I", len(text)) + _JSON_CHUNK + text)
        out.write(struct.pack("<I", size) + _BINARY_CHUNK)
        for array in arrays:
            out.write(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
