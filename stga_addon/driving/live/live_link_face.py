"""Live Link Face's UDP packets, as Unreal Engine's ARKit plug-in serializes them."""

import struct

import numpy as np

from ..performance import (
    ARKIT_SHAPES,
    COLUMN,
    COUNT,
    EXCHANGEABLE,
    MAX_WEIGHT,
    OPTIONAL,
    FacePacket,
)

VERSION = 6
MAX_TEXT_BYTES = 512
ROTATIONS = 9  # Yaw, pitch and roll of the head and of both eyes, after the shapes
_TIME = struct.Struct(">ifii")
_EXCHANGED = {
    f"{pair}{side}": f"{pair}{other}"
    for pair in EXCHANGEABLE
    for side, other in (("Left", "Right"), ("Right", "Left"))
}
PACKET_SHAPES = tuple(_EXCHANGED.get(name, name) for name in ARKIT_SHAPES)
"""In the order of the packets, which have the left of jaw and mouth first, unlike the app's CSV
files."""
_PACKET_COLUMNS = np.array([COLUMN[name] for name in PACKET_SHAPES])


def decode(data: bytes) -> FacePacket | None:
    """The frame of a packet, or None for bytes that are none.

    Layout, big-endian: u8 version; device and subject, each i32 length and UTF-8; i32 frame, f32
    subframe, i32 rate, i32 denominator; u8 count, then count f32: 61, or as few as the 51 or 52
    shapes. Without a face, the packet ends before the count, or counts 0. Source: Unreal Engine's
    AppleARKitFaceSupport.
    """
    if not data or data[0] != VERSION:
        return None
    texts, at = [], 1
    for _ in range(2):
        found = _text(data, at)
        if found is None:
            return None
        text, at = found
        texts.append(text)
    if len(data) < at + _TIME.size:
        return None
    frame, part, rate, denominator = _TIME.unpack_from(data, at)
    at += _TIME.size
    has_clock = rate > 0 and denominator > 0 and np.isfinite(part)
    time = (frame + part) * denominator / rate if has_clock else None
    subject = texts[1] or texts[0]
    count = data[at] if len(data) > at else 0
    if count == 0:
        return FacePacket((), None, None, subject, time) if len(data) <= at + 1 else None
    if len(data) != at + 1 + 4 * count or count not in (COUNT - 1, COUNT, COUNT + ROTATIONS):
        return None
    values = np.array(struct.unpack_from(f">{count}f", data, at + 1))
    if not (np.abs(values) <= MAX_WEIGHT).all():
        return None
    names = PACKET_SHAPES
    if len(values) < COUNT:
        names = tuple(name for name in PACKET_SHAPES if name not in OPTIONAL)
    weights = np.zeros(COUNT)
    weights[_PACKET_COLUMNS[: len(names)]] = values[: len(names)]
    head = None
    if len(values) == COUNT + ROTATIONS:
        yaw, pitch, roll = values[COUNT : COUNT + 3].tolist()
        head = (yaw, pitch, roll)
    return FacePacket(names, weights, head, subject, time)


def _text(data: bytes, at: int) -> tuple[str, int] | None:
    """The text whose i32 length stands at `at`, and where it ends."""
    if len(data) < at + 4:
        return None
    (length,) = struct.unpack_from(">i", data, at)
    end = at + 4 + length
    if not 0 <= length <= MAX_TEXT_BYTES or end > len(data):
        return None
    try:
        return data[at + 4 : end].decode("utf-8"), end
    except UnicodeDecodeError:
        return None
