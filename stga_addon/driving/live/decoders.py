"""Datagrams of Live Link Face and of the Virtual Motion Capture protocol (OSC) as ARKit weights."""

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TypeGuard

import numpy as np

from ..head_rotations import angles_of_quaternions
from ..performance import (
    ARKIT_SHAPES,
    COLUMN,
    COUNT,
    MAX_WEIGHT,
    OPTIONAL,
    FacePacket,
    arkit_name,
    mirrored_name,
)

VERSION = 6
"""First byte of Live Link Face's packets."""
MAX_TEXT_BYTES = 512
"""Longest name of a device or subject in a packet."""

ROTATIONS = 9
"""Yaw, pitch and roll of the head and of both eyes, after the shapes."""
PACKET_SHAPES = tuple(
    mirrored_name(name) if re.fullmatch("(jaw|mouth)(Left|Right)", name) else name
    for name in ARKIT_SHAPES
)
"""Shapes in the order of the packets, which have the left of jaw and mouth first, unlike the app's
CSV files."""


def decode_live_link_face(data: bytes) -> FacePacket | None:
    """The frame of a packet as Unreal Engine's ARKit plug-in serializes it, or None for bytes that
    are none.

    Layout, big-endian: u8 version; device and subject, each i32 length and UTF-8; i32 frame, f32
    subframe, i32 rate, i32 denominator; u8 count, then count f32: 61, or as few as the 51 or 52
    shapes. Without a face, the packet ends before the count, or counts 0. Source: Unreal Engine's
    AppleARKitFaceSupport.
    """
    texts = []
    at = 1
    try:
        for _ in range(2):
            (length,) = struct.unpack_from(">i", data, at)
            at += 4 + length
            if data[0] != VERSION or not 0 <= length <= MAX_TEXT_BYTES:
                return None
            texts.append(data[at - length : at].decode("utf-8"))
        frame, part, rate, denominator = struct.unpack_from(">ifii", data, at)
    except (struct.error, UnicodeDecodeError):
        return None
    at += 16
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
    if count < COUNT:
        names = tuple(name for name in PACKET_SHAPES if name not in OPTIONAL)
    weights = np.zeros(COUNT)
    weights[[COLUMN[name] for name in names]] = values[: len(names)]
    yaw, pitch, roll = [*values[COUNT : COUNT + 3].tolist(), 0, 0, 0][:3]
    head = (yaw, pitch, roll) if count > COUNT else None
    return FacePacket(names, weights, head, subject, time)


Value = int | float | str | bytes | bool | None
Message = tuple[str, tuple[Value, ...]]
MAX_DEPTH = 4  # Largest depth of nested bundles
_BUNDLE = b"#bundle\0"
_NUMBERS = {"i": ">i", "f": ">f", "h": ">q", "d": ">d", "t": ">Q", "c": ">i", "r": ">I", "m": ">I"}
_CONSTANTS: dict[str, Value] = {"T": True, "F": False, "N": None, "I": math.inf}


def osc_messages(data: bytes, depth: int = 0) -> Iterator[Message]:
    """Address and arguments of a datagram's messages (Open Sound Control 1.0), in order. Raises
    struct.error or ValueError where it is malformed."""
    if data.startswith(_BUNDLE):
        if depth >= MAX_DEPTH or len(data) < 16:
            raise ValueError("too deep, or cut off")
        at = 16
        while at < len(data):
            part, at = _blob(data, at)
            if not part:
                raise ValueError("an empty packet")
            yield from osc_messages(part, depth + 1)
        return
    address, at = _text(data, 0)
    types, at = _text(data, at)
    if not address.startswith("/") or not types.startswith(","):
        raise ValueError("neither address nor type tags")
    values: list[Value] = []
    for kind in types[1:]:
        value: Value
        if kind in _CONSTANTS:
            value = _CONSTANTS[kind]
        elif kind in "sS":
            value, at = _text(data, at)
        elif kind == "b":
            value, at = _blob(data, at)
            at += -len(value) % 4
        elif kind in _NUMBERS:
            (value,) = struct.unpack_from(_NUMBERS[kind], data, at)
            at += struct.calcsize(_NUMBERS[kind])
        else:
            raise ValueError("another type")
        values.append(value)
    yield address, tuple(values)


def _blob(data: bytes, at: int) -> tuple[bytes, int]:
    """The bytes whose i32 length stands at `at`, and where they end."""
    (size,) = struct.unpack_from(">i", data, at)
    end = at + 4 + size
    if size < 0 or end > len(data):
        raise ValueError("cut off")
    return data[at + 4 : end], end


def _text(data: bytes, at: int) -> tuple[str, int]:
    """The zero-terminated text at `at`, padded to four bytes, and where it ends."""
    end = data.index(b"\0", at)
    return data[at:end].decode("utf-8"), end + 4 - (end - at) % 4


@dataclass(frozen=True)
class Received:
    """What a sender said so far: values come one by one, and count when they are applied.

    time       its latest; applied: that of the last frame
    has_clock  whether each frame had a new time: of some senders it stands still, or comes more
               seldom
    """

    weights: np.ndarray = field(default_factory=lambda: np.zeros(COUNT))
    names: frozenset[str] = frozenset()
    head: tuple[float, float, float] | None = None
    time: float | None = None
    applied: float | None = math.nan
    has_clock: bool = True


def decode_vmc(data: bytes, before: Received) -> tuple[FacePacket | None, Received] | None:
    """The frame that a datagram applies, if any, and what is known after it; None for bytes that
    are no VMC.

    before: what was known from this sender's earlier datagrams. Shapes have ARKit's names in any
    spelling; VRM's own expressions (A, Joy, …) are left out. Source: the protocol's specification
    (protocol.vmc.info).
    """
    try:
        found = [*osc_messages(data)]
    except (struct.error, ValueError):
        return None
    if not any(address.startswith("/VMC/") for address, _ in found):
        return None
    weights = before.weights.copy()
    names = set(before.names)
    known = replace(before, weights=weights)
    packet = None
    for address, values in found:  # of malformed messages nothing is taken
        numbers = [float(value) for value in values if _is_number(value)]
        match address, values:
            case "/VMC/Ext/Blend/Val", (str(text), _) if numbers and abs(numbers[0]) <= MAX_WEIGHT:
                name = arkit_name(text)
                if name is not None:
                    weights[COLUMN[name]] = numbers[0]
                    names.add(name)
            case "/VMC/Ext/T", (_,) if numbers:
                known = replace(known, time=numbers[0])
            case "/VMC/Ext/Bone/Pos", (str(text), *rest) if text.lower() == "head":
                if len(rest) == 7 and all(map(_is_number, rest[3:])):
                    known = replace(known, head=_head(numbers[-4:]) or known.head)
            case "/VMC/Ext/Blend/Apply", _ if names:
                moves = known.has_clock and known.time != known.applied
                known = replace(known, applied=known.time, has_clock=moves)
                time = known.time if moves else None
                packet = FacePacket(tuple(sorted(names)), weights.copy(), known.head, "", time)
    return packet, replace(known, names=frozenset(names))


def _is_number(value: Value) -> TypeGuard[int | float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e30


def _head(quaternion: list[float]) -> tuple[float, float, float] | None:
    """Yaw, pitch, roll of Unity's quaternion: left-handed, mirrored in x, so y and z turn back."""
    if not 0.5 < math.hypot(*quaternion) < 2:
        return None
    x, y, z, w = quaternion
    yaw, pitch, roll = angles_of_quaternions(np.array([[-y, x, -z, w]]))[0].tolist()
    return yaw, pitch, roll
