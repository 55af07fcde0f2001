"""Messages to and from a process in another Python interpreter, over its pipes.

A message is a mark, a length, then named arrays as an npz without pickle. Importing this needs
numpy only.
"""

import io
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

MARK = b"stga"
"""First bytes of a message."""


def send(stream: BinaryIO, arrays: Mapping[str, Any]) -> None:
    """Write one message."""
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    stream.write(MARK + packed.tell().to_bytes(8, "little"))
    stream.write(packed.getbuffer())
    stream.flush()


def receive(stream: BinaryIO) -> dict[str, np.ndarray]:
    """Read one message. Raises EOFError at the stream's end, ValueError for anything else."""

    def read(size: int) -> bytes:
        parts = []
        while size:
            parts.append(stream.read(size))
            if not parts[-1]:
                raise EOFError
            size -= len(parts[-1])
        return b"".join(parts)

    mark = read(len(MARK))
    size = int.from_bytes(read(8), "little")
    if mark != MARK:
        raise ValueError(f"a message begins with {MARK!r}, got {mark!r}")
    with np.load(io.BytesIO(read(size)), allow_pickle=False) as arrays:
        return dict(arrays)
