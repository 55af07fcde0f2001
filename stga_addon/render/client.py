"""Render client: renders in this process, or through a render server in another interpreter where
packages are missing; the server, `python -m stga_addon.render.client DEVICE`, and their messages.

Importing this needs numpy only.
"""

import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from importlib.util import find_spec
from typing import Any, BinaryIO, cast

import numpy as np

from ..avatar.embedding import FaceFrames
from ..avatar.splats import Splats
from ..capture.camera import Camera
from ..errors import StgaError
from ..raster.posed_splats import ComposedImage, PosedSplats
from ..worker.helpers import claim_stdout
from ..worker.launch import start_python
from ..worker.messages import receive, send
from .composer import Composer

REQUIRED_PACKAGES = ("numba", "platformdirs")
"""Packages that the kernels need beside numpy."""
SPLAT_FIELDS = [field.name for field in fields(Splats)]
LAYER_FIELDS = [field.name for field in fields(PosedSplats)][2:]
FRAME_FIELDS = [field.name for field in fields(FaceFrames)]


class RenderClient:
    """Renders layers for any thread, one image at a time.

    find_python: the interpreter of the server where this one lacks REQUIRED_PACKAGES; raises
    StgaError if none is set.
    find_device: the device, as `Composer` takes it.

    failure  why the CPU renders instead of a GPU that has failed; "" where none has
    """

    def __init__(
        self, find_python: Callable[[], str], find_device: Callable[[], str] = lambda: "auto"
    ) -> None:
        self._find_python = find_python
        self._find_device = find_device
        self._lock = threading.Lock()
        self._composer = Composer()
        self._server: tuple[str, subprocess.Popen[bytes]] | None = None
        self._server_device = self.failure = ""

    def compose(
        self, layers: Sequence[PosedSplats], camera: Camera, with_depth: bool = False
    ) -> ComposedImage:
        """`Composer.compose`, here or by the server. Raises StgaError where neither can render."""
        with self._lock:
            device = self._find_device()
            if missing_packages():
                if device != self._server_device:
                    self.close()
                return self._request(layers, camera, with_depth)
            if device != self._composer.requested:
                self._composer = Composer(device)
            image = self._composer.compose(layers, camera, with_depth)
            self.failure = self._composer.failure
            return image

    def close(self) -> None:
        """End the server, if one is running; the next image starts another."""
        running = self._server
        self._server = None
        if running is not None:
            _, server = running
            server.kill()
            server.wait()
            for pipe in (server.stdin, server.stdout):
                with suppress(OSError):  # data that was not yet written
                    cast(BinaryIO, pipe).close()

    def _request(
        self, layers: Sequence[PosedSplats], camera: Camera, with_depth: bool
    ) -> ComposedImage:
        if self._server is None:
            try:
                python = self._find_python()
            except StgaError as error:
                raise StgaError(
                    f"Rendering splats needs {' and '.join(missing_packages())} in Blender's "
                    f"own Python ({sys.executable}, {sys.version.split()[0]}), or another "
                    "Python with them, which is chosen in the add-on's preferences"
                ) from error
            self._server_device = self._find_device()
            arguments = ["stga_addon.render.client", self._server_device]
            started = start_python(python, arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            self._server = python, started
        python, server = self._server
        request = {**pack_camera(camera), **pack_layers(layers), "with_depth": with_depth}
        try:
            send(cast(BinaryIO, server.stdin), request)
            reply = receive(cast(BinaryIO, server.stdout))
        except (OSError, EOFError, ValueError) as error:
            self.close()
            raise StgaError(
                f"{python}: the render server exited unexpectedly; that Python needs numba"
            ) from error
        self.failure = str(reply.get("failure", ""))
        if "error" in reply:
            raise StgaError(
                f"{python}: the render server could not render the image ({reply['error']})"
            )
        return ComposedImage(reply["rgb"], reply["alpha"], reply["depth"] if with_depth else None)


def missing_packages() -> list[str]:
    """Those of REQUIRED_PACKAGES that this interpreter lacks."""
    return [name for name in REQUIRED_PACKAGES if find_spec(name) is None]


def pack_camera(camera: Camera) -> dict[str, Any]:
    """A camera as named arrays."""
    return {"camera": np.array(camera.intrinsics), "pose": camera.world_to_camera}


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
        arrays |= {f"{index} {name}": getattr(layer, name) for name in LAYER_FIELDS}
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
        to_world, antialiased, holdout = (arrays[f"{index} {name}"] for name in LAYER_FIELDS)
        layers.append(PosedSplats(splats, frames, to_world, bool(antialiased), bool(holdout)))
    return layers


def serve(requests: BinaryIO, replies: BinaryIO, device: str) -> None:
    """Answer requests until the stream ends; device: as `Composer` takes it."""
    composer = Composer(device)
    while True:
        try:
            request = receive(requests)
        except EOFError:
            return
        try:
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
