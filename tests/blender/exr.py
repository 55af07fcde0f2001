"""Reads the uncompressed float OpenEXR files that a test lets Blender write."""

import struct

import numpy as np

MULTI_PART = 0x1000


def read_exr(path):
    """Channel name -> (H, W) float32, top row first, of scanlines without compression."""
    data = path.read_bytes()
    magic, version = struct.unpack_from("<2i", data)
    assert magic == 20000630
    headers = []
    at = 8
    while data[at]:
        header, at = _header(data, at)
        headers.append(header)
        if not version & MULTI_PART:
            break
    at += bool(version & MULTI_PART)
    found = {}
    for header in headers:
        x0, y0, x1, y1 = struct.unpack("<4i", header["dataWindow"])
        width = x1 - x0 + 1
        height = y1 - y0 + 1
        names = _channels(header["channels"])
        rows = np.empty((height, len(names), width), np.float32)
        for start in struct.unpack_from(f"<{height}q", data, at):
            start += 4 * bool(version & MULTI_PART)  # the part's number
            (y,) = struct.unpack_from("<i", data, start)
            rows[y - y0] = np.frombuffer(data, "<f4", len(names) * width, start + 8).reshape(
                len(names), width
            )
        at += 8 * height
        found |= {name: rows[:, index] for index, name in enumerate(names)}
    return found


def _header(data, at):
    header = {}
    while data[at]:
        name, kind, _ = data[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<i", data, at)
        header[name.decode()] = data[at + 4 : at + 4 + size]
        at += 4 + size
    assert header["compression"] == b"\0"
    return header, at + 1


def _channels(left):
    names = []
    while left[0]:
        name, left = left.split(b"\0", 1)
        assert left[:4] == struct.pack("<i", 2), "not 32-bit float"
        names.append(name.decode())
        left = left[16:]
    return names
