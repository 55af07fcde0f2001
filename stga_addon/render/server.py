"""Render server, `python -m stga_addon.render.server DEVICE`, and its messages with the client.

A message is a mark, a length, then named arrays as an npz without pickle.
"""

import io
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, BinaryIO

import numpy as np

from ..avatar.embedding import FaceFrames
from ..avatar.splats import Splats
from ..capture.camera import Camera
from ..raster.posed_splats import PosedSplats
from ..worker.helpers import claim_stdout

MARK = b"stga"
SPLAT_FIELDS = [field.name for field in fields(Splats)]
FRAME_FIELDS = [field.name for field in fields(FaceFrames)]


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

    mark, size = read(len(MARK)), int.from_bytes(read(8), "little")
    if mark != MARK:
        raise ValueError(f"a message begins with {MARK!r}, got {mark!r}")
    with np.load(io.BytesIO(read(size)), allow_pickle=False) as arrays:
        return dict(arrays)


def pack_camera(camera: Camera) -> dict[str, Any]:
    """A camera as named arrays."""
    intrinsics = [camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy]
    return {"camera": np.array(intrinsics), "pose": camera.world_to_camera}


def unpack_camera(arrays: Mapping[str, np.ndarray]) -> Camera:
    """The inverse of `pack_camera`. Raises KeyError or ValueError where it is damaged."""
    width, height, fl_x, fl_y, cx, cy = arrays["camera"].tolist()
    return Camera(int(width), int(height), fl_x, fl_y, cx, cy, arrays["pose"])


def pack_layers(
    layers: Sequence[PosedSplats], before: Sequence[PosedSplats] = ()
) -> dict[str, Any]:
    """Layers as named arrays, less splats that the layer `before` at their index has."""
    arrays: dict[str, Any] = {"layers": len(layers)}
    for index, layer in enumerate(layers):
        splats = {name: getattr(layer.splats, name) for name in SPLAT_FIELDS}
        known = before[index].splats if index < len(before) else None
        is_same = known is layer.splats or (
            known is not None
            and all(np.array_equal(values, getattr(known, name)) for name, values in splats.items())
        )
        if not is_same:
            arrays |= {f"{index} splats {name}": values for name, values in splats.items()}
        arrays |= {f"{index} frames {name}": getattr(layer.frames, name) for name in FRAME_FIELDS}
        arrays |= {f"{index} to_world": layer.to_world, f"{index} antialiased": layer.antialiased}
    return arrays


def unpack_layers(
    arrays: Mapping[str, np.ndarray], before: Sequence[PosedSplats] = ()
) -> list[PosedSplats]:
    """The inverse of `pack_layers`. Raises KeyError where splats are in neither."""
    layers = []
    for index in range(int(arrays["layers"])):
        if f"{index} splats {SPLAT_FIELDS[0]}" in arrays or index >= len(before):
            splats = Splats(*(arrays[f"{index} splats {name}"] for name in SPLAT_FIELDS))
        else:
            splats = before[index].splats
        frames = FaceFrames(*(arrays[f"{index} frames {name}"] for name in FRAME_FIELDS))
        antialiased = bool(arrays[f"{index} antialiased"])
        layers.append(PosedSplats(splats, frames, arrays[f"{index} to_world"], antialiased))
    return layers


def serve(requests: BinaryIO, replies: BinaryIO, device: str) -> None:
    """Answer requests until the stream ends; layers are kept until a request brings others.

    device: as `Composer` takes it.
    """
    from ..errors import StgaError
    from .device import Composer

    layers: list[PosedSplats] = []
    composer = Composer(device)
    while True:
        try:
            request = receive(requests)
        except EOFError:
            return
        try:
            if "layers" in request:
                layers = unpack_layers(request)
            image = composer.compose(layers, unpack_camera(request), bool(request["with_depth"]))
        except Exception as error:  # the client reports it, whatever it is
            kind = "" if isinstance(error, StgaError) else f"{type(error).__name__}: "
            send(replies, {"error": f"{kind}{error}"})
        else:
            reply = {"rgb": image.rgb, "alpha": image.alpha, "failure": composer.failure}
            send(replies, reply if image.depth is None else reply | {"depth": image.depth})


if __name__ == "__main__":
    replies = claim_stdout()
    serve(sys.stdin.buffer, replies, sys.argv[1])
