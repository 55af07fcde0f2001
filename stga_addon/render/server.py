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
    """Read one message. Raises EOFError at the end of the stream, ValueError for what is no
    message."""
    mark, size = (
        _read_exactly(stream, len(MARK)),
        int.from_bytes(_read_exactly(stream, 8), "little"),
    )
    if mark != MARK:
        raise ValueError(f"a message begins with {MARK!r}, got {mark!r}")
    with np.load(io.BytesIO(_read_exactly(stream, size)), allow_pickle=False) as arrays:
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
    """Layers as named arrays; without the splats of those that have the same as the layer `before`
    at their index."""
    arrays: dict[str, Any] = {"layers": len(layers)}
    for index, layer in enumerate(layers):
        if index >= len(before) or not _same_splats(layer.splats, before[index].splats):
            arrays |= {
                f"{index} splats {name}": getattr(layer.splats, name) for name in SPLAT_FIELDS
            }
        arrays |= {f"{index} frames {name}": getattr(layer.frames, name) for name in FRAME_FIELDS}
        arrays |= {f"{index} to_world": layer.to_world, f"{index} antialiased": layer.antialiased}
    return arrays


def unpack_layers(
    arrays: Mapping[str, np.ndarray], before: Sequence[PosedSplats] = ()
) -> list[PosedSplats]:
    """The inverse of `pack_layers`. Raises KeyError where splats are missing from the arrays and
    from `before`."""
    names = [
        [f"{index} splats {name}" for name in SPLAT_FIELDS]
        for index in range(int(arrays["layers"]))
    ]
    splats = [
        Splats(**{field: arrays[name] for field, name in zip(SPLAT_FIELDS, stored, strict=True)})
        if stored[0] in arrays or index >= len(before)
        else before[index].splats
        for index, stored in enumerate(names)
    ]
    return [
        PosedSplats(
            splats[index],
            FaceFrames(**{name: arrays[f"{index} frames {name}"] for name in FRAME_FIELDS}),
            arrays[f"{index} to_world"],
            bool(arrays[f"{index} antialiased"]),
        )
        for index in range(len(splats))
    ]


def _same_splats(one: Splats, other: Splats) -> bool:
    return one is other or all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in SPLAT_FIELDS
    )


def _read_exactly(stream: BinaryIO, size: int) -> bytes:
    parts = []
    while size:
        part = stream.read(size)
        if not part:
            raise EOFError
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def serve(requests: BinaryIO, replies: BinaryIO, device: str) -> None:
    """Answer requests until the stream ends; layers are kept until a request brings others.

    device: as `Composer` takes it.
    """
    from ..errors import StgaError
    from ..raster.posed_splats import PosedSplats
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
            depth = {} if image.depth is None else {"depth": image.depth}
            send(
                replies,
                {"rgb": image.rgb, "alpha": image.alpha, "failure": composer.failure, **depth},
            )


if __name__ == "__main__":
    replies = claim_stdout()
    serve(sys.stdin.buffer, replies, sys.argv[1])
