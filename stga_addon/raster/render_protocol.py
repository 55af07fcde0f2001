"""Arrays between a process that wants pictures and one that draws them: a length, then an npz without pickle."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, BinaryIO

import numpy as np

from ..avatar.embedding import FaceFrames
from ..avatar.splats import Splats
from .posed_splats import PosedSplats

SPLATS = [field.name for field in fields(Splats)]
FRAMES = [field.name for field in fields(FaceFrames)]


def send(stream: Any, arrays: Mapping[str, Any]) -> None:
    """Write one message."""
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    stream.write(packed.tell().to_bytes(8, "little"))
    stream.write(packed.getbuffer())
    stream.flush()


def receive(stream: BinaryIO | Any) -> dict[str, np.ndarray]:
    """Read one message. Raises EOFError where the other side is gone."""
    size = int.from_bytes(_exactly(stream, 8), "little")
    with np.load(io.BytesIO(_exactly(stream, size)), allow_pickle=False) as arrays:
        return dict(arrays)


def pack_layers(layers: Sequence[PosedSplats]) -> dict[str, Any]:
    """Layers as named arrays."""
    arrays: dict[str, Any] = {"layers": len(layers)}
    for index, layer in enumerate(layers):
        arrays |= {f"{index} splats {name}": getattr(layer.splats, name) for name in SPLATS}
        arrays |= {f"{index} frames {name}": getattr(layer.frames, name) for name in FRAMES}
        arrays |= {f"{index} to_world": layer.to_world, f"{index} antialiased": layer.antialiased}
    return arrays


def unpack_layers(arrays: Mapping[str, np.ndarray]) -> list[PosedSplats]:
    """The inverse of `pack_layers`."""
    return [
        PosedSplats(
            Splats(**{name: arrays[f"{index} splats {name}"] for name in SPLATS}),
            FaceFrames(**{name: arrays[f"{index} frames {name}"] for name in FRAMES}),
            arrays[f"{index} to_world"],
            bool(arrays[f"{index} antialiased"]),
        )
        for index in range(int(arrays["layers"]))
    ]


def _exactly(stream: BinaryIO | Any, size: int) -> bytes:
    parts = []
    while size:
        part = stream.read(size)
        if not part:
            raise EOFError
        parts.append(part)
        size -= len(part)
    return b"".join(parts)
