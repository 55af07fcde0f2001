"""Meshes made to break their readers: lies about size, references, parsers that do not end."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stga_addon.capture.meshes import read_mesh

from .limits import GIGA, behaves


def glb(document: dict[str, Any], data: bytes = b"") -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<2L", len(text), 0x4E4F534A) + text
    if data:
        chunks += struct.pack("<2L", len(data), 0x004E4942) + data
    return struct.pack("<3L", 0x46546C67, 2, 12 + len(chunks)) + chunks


def gltf(**changes: Any) -> bytes:
    """One triangle; `changes` replace parts of the document."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    data = points + np.array([0, 1, 2], "<u4").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "buffers": [{"byteLength": 48}],
    }
    return glb({**document, **changes}, data)


def accessors(**changes: Any) -> list[dict[str, Any]]:
    first = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", **changes}
    kept = {key: value for key, value in first.items() if value is not None}
    return [kept, {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"}]


PLY_LIST = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"


def ply(vertices: int, rest: bytes, kind: str = "binary_little_endian") -> bytes:
    coordinates = "property float x\nproperty float y\nproperty float z\n"
    return f"ply\nformat {kind} 1.0\nelement vertex {vertices}\n{coordinates}".encode() + rest


MESHES: dict[str, tuple[str, bytes]] = {
    "glb": ("glb", gltf()),
    "glb of a billion points": ("glb", gltf(accessors=accessors(count=GIGA))),
    "glb of a billion points without data": (
        "glb",
        gltf(accessors=accessors(count=GIGA, bufferView=None)),
    ),
    "glb of negative counts": ("glb", gltf(accessors=accessors(count=-3))),
    "glb of a count as text": ("glb", gltf(accessors=accessors(count="3"))),
    "glb of matrices": ("glb", gltf(accessors=accessors(type="MAT4"))),
    "glb whose nodes form a ring": (
        "glb",
        gltf(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]),
    ),
    "glb whose node is its child": ("glb", gltf(nodes=[{"mesh": 0, "children": [0]}])),
    "glb that doubles itself": (
        "glb",
        gltf(nodes=[*({"children": [n + 1, n + 1]} for n in range(30)), {"mesh": 0}]),
    ),
    "glb of a distant buffer": (
        "glb",
        gltf(buffers=[{"byteLength": 48, "uri": "../../etc/passwd"}]),
    ),
    "glb of a server": ("glb", gltf(buffers=[{"byteLength": 48, "uri": "http://127.0.0.1:9/x"}])),
    "glb of huge matrices": ("glb", gltf(nodes=[{"mesh": 0, "matrix": [1e308] * 16}])),
    "glb of few matrices": ("glb", gltf(nodes=[{"mesh": 0, "matrix": [1] * 3}])),
    "glb of a huge chunk": ("glb", struct.pack("<5L", 0x46546C67, 2, 100, 2**32 - 1, 0x4E4F534A)),
    "ply of a billion vertices": ("ply", ply(GIGA, b"end_header\n" + bytes(36))),
    "ply of a billion lines": (
        "ply",
        ply(GIGA, PLY_LIST.format(GIGA).encode() + b"0 0 0\n" * 3, "ascii"),
    ),
    "ply of a billion triangles": (
        "ply",
        ply(3, PLY_LIST.format(GIGA).encode() + bytes(36) + b"\x03" + bytes(12)),
    ),
    "ply of long polygons": (
        "ply",
        ply(
            3,
            PLY_LIST.replace("uchar", "uint").format(2).encode() + bytes(36) + b"\xff\xff\xff\x7f",
        ),
    ),
    "stl of a billion triangles": ("stl", bytes(80) + struct.pack("<L", GIGA) + bytes(50)),
    "stl of text": ("stl", b"solid x\n" + b"facet normal 0 0 1\nouter loop\n" * 1000),
    "obj of huge indices": ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 " + b"9" * 5000 + b"\n"),
    "obj of huge numbers": ("obj", b"v 0 0 1e400\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    "obj of one polygon": ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + b"1 " * 150_000 + b"\n"),
    "obj of nothing but lines": ("obj", b"\n" * 1_000_000),
    "obj that includes": (
        "obj",
        b"mtllib /etc/passwd\ncall x.obj\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    ),
}


@pytest.mark.parametrize("name", MESHES)
def test_meshes(tmp_path: Path, name: str) -> None:
    """Catches memory allocated on a header's word, files read or servers asked because a mesh names
    them, and parsers that do not end."""
    suffix, content = MESHES[name]
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)
    message = behaves(lambda: read_mesh(path), tmp_path)
    loads = ("glb", "glb of huge matrices", "obj that includes", "obj of one polygon")
    assert (message == "") == (name in loads)
