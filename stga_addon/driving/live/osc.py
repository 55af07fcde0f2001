"""Open Sound Control 1.0: datagrams as messages."""

import struct

Value = int | float | str | bytes | bool | None
Message = tuple[str, tuple[Value, ...]]
MAX_MESSAGES, MAX_DEPTH = 4096, 4
_BUNDLE = b"#bundle\0"
_NUMBERS = {"i": ">i", "f": ">f", "h": ">q", "d": ">d", "t": ">Q", "c": ">i", "r": ">I", "m": ">I"}
_CONSTANTS: dict[str, Value] = {"T": True, "F": False, "N": None, "I": float("inf")}


def messages(data: bytes) -> list[Message] | None:
    """Address and arguments of every message of a datagram, those of bundles in their order; None for other bytes."""
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
