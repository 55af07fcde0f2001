"""The Virtual Motion Capture protocol: shapes and bones as Open Sound Control 1.0."""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..performance import COLUMN, COUNT, MAX_WEIGHT, FacePacket, arkit_name

Value = int | float | str | bytes | bool | None
Message = tuple[str, tuple[Value, ...]]
MAX_MESSAGES, MAX_DEPTH = 4096, 4
_BUNDLE = b"#bundle\0"
_NUMBERS = {"i": ">i", "f": ">f", "h": ">q", "d": ">d", "t": ">Q", "c": ">i", "r": ">I", "m": ">I"}
_CONSTANTS: dict[str, Value] = {"T": True, "F": False, "N": None, "I": float("inf")}


def messages(data: bytes) -> list[Message] | None:
    """Address and arguments of a datagram's messages, in order; None for other bytes."""
    found: list[Message] = []
    return found if _read(data, found, 0) else None


def _read(data: bytes, found: list[Message], depth: int) -> bool:
    """Append what a packet holds; whether it is well formed."""
    if not data.startswith(_BUNDLE):
        message = _message(data)
        if message is None or len(found) >= MAX_MESSAGES:
            return False
        found.append(message)
        return True
    if depth >= MAX_DEPTH or len(data) < 16:
        return False
    at = 16
    while at < len(data):
        if len(data) < at + 4:
            return False
        (size,) = struct.unpack_from(">i", data, at)
        at += 4
        if size <= 0 or at + size > len(data) or not _read(data[at : at + size], found, depth + 1):
            return False
        at += size
    return True


def _message(data: bytes) -> Message | None:
    address = _text(data, 0)
    if address is None or not address[0].startswith("/"):
        return None
    types = _text(data, address[1])
    if types is None or not types[0].startswith(","):
        return None
    values, at = [], types[1]
    for kind in types[0][1:]:
        argument = _argument(data, at, kind)
        if argument is None:
            return None
        value, at = argument
        values.append(value)
    return address[0], tuple(values)


def _argument(data: bytes, at: int, kind: str) -> tuple[Value, int] | None:
    """The value of a type tag at `at`, and where the next one begins."""
    if kind in _CONSTANTS:
        return _CONSTANTS[kind], at
    if kind in "sS":
        return _text(data, at)
    if kind == "b":
        if len(data) < at + 4:
            return None
        (size,) = struct.unpack_from(">i", data, at)
        end = at + 4 + size
        return (data[at + 4 : end], end + -size % 4) if size >= 0 and end <= len(data) else None
    form = _NUMBERS.get(kind)
    if form is None or len(data) < at + struct.calcsize(form):
        return None
    return struct.unpack_from(form, data, at)[0], at + struct.calcsize(form)


def _text(data: bytes, at: int) -> tuple[str, int] | None:
    """The zero-terminated text at `at`, padded to four bytes, and where it ends."""
    end = data.find(b"\0", at)
    if end < 0:
        return None
    try:
        return data[at:end].decode("utf-8"), end + 4 - (end - at) % 4
    except UnicodeDecodeError:
        return None


VALUE, APPLY = "/VMC/Ext/Blend/Val", "/VMC/Ext/Blend/Apply"
TIME, BONE = "/VMC/Ext/T", "/VMC/Ext/Bone/Pos"
HEAD_BONE = "head"


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


def decode(data: bytes, before: Received) -> tuple[FacePacket | None, Received] | None:
    """The frame that a datagram applies, if any, and what is known after it; None for bytes that
    are no VMC.

    before: what was known from this sender's earlier datagrams. Shapes have ARKit's names in any
    spelling; VRM's own
    expressions (A, Joy, …) are left out. Source: the protocol's specification (protocol.vmc.info).
    """
    found = messages(data)
    if found is None or not any(address.startswith("/VMC/") for address, _ in found):
        return None
    known, packet = before, None
    for message in found:
        known = _with(known, message)
        if message[0] == APPLY and known.names:
            moves = known.has_clock and known.time != known.applied
            known = replace(known, applied=known.time, has_clock=moves)
            time = known.time if moves else None
            packet = FacePacket(tuple(sorted(known.names)), known.weights, known.head, "", time)
    return packet, known


def _with(known: Received, message: Message) -> Received:
    """What is known after a message; of malformed ones nothing is taken."""
    address, values = message
    if address == VALUE and len(values) == 2 and isinstance(values[0], str):
        name, value = arkit_name(values[0]), _number(values[1])
        if name is None or value is None or not abs(value) <= MAX_WEIGHT:
            return known
        weights = known.weights.copy()
        weights[COLUMN[name]] = value
        return replace(known, weights=weights, names=known.names | {name})
    if address == TIME and len(values) == 1 and _number(values[0]) is not None:
        return replace(known, time=_number(values[0]))
    if (
        address == BONE
        and len(values) == 8
        and isinstance(values[0], str)
        and values[0].lower() == HEAD_BONE
    ):
        head = _head(values[4:])
        return known if head is None else replace(known, head=head)
    return known


def _head(values: Sequence[Value]) -> tuple[float, float, float] | None:
    """Yaw, pitch, roll of Unity's quaternion: left-handed, mirrored in x, so y and z turn back."""
    numbers = [value for value in map(_number, values) if value is not None]
    length = math.sqrt(sum(value * value for value in numbers))
    if len(numbers) != 4 or not 0.5 < length < 2:
        return None
    x, y, z, w = numbers
    x, y, z, w = x / length, -y / length, -z / length, w / length
    yaw = math.atan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * x - y * z))))
    return yaw, pitch, math.atan2(2 * (x * y + w * z), 1 - 2 * (x * x + z * z))


def _number(value: Value) -> float | None:
    """A finite number as float; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e30:
        return None
    return float(value)
