"""Render client: renders in this process, or through a render server in another interpreter where
packages are missing.

Importing this needs numpy only.
"""

import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from typing import BinaryIO, cast

from ..capture.camera import Camera
from ..errors import StgaError
from ..raster.posed_splats import ComposedImage, PosedSplats
from ..worker.launch import start_python
from .device import Composer
from .server import pack_camera, pack_layers, receive, send

REQUIRED_PACKAGES = ("numba", "platformdirs")
"""What the kernels need beside numpy, by the names of the packages."""


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
        self._find_python, self._find_device = find_python, find_device
        self._lock = threading.Lock()
        self._composer = Composer()
        self._server: tuple[str, subprocess.Popen[bytes]] | None = None
        self._server_device = self.failure = ""
        self._sent: Sequence[PosedSplats] | None = None

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
        running, self._server, self._sent = self._server, None, None
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
            python, self._server_device = self._python(), self._find_device()
            arguments = ["stga_addon.render.server", self._server_device]
            started = start_python(python, arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            self._server = python, started
        python, server = self._server
        request = {**pack_camera(camera), "with_depth": with_depth}
        if layers is not self._sent:
            request |= pack_layers(layers)
        try:
            send(cast(BinaryIO, server.stdin), request)
            reply = receive(cast(BinaryIO, server.stdout))
        except (OSError, EOFError, ValueError) as error:
            self.close()
            raise StgaError(
                f"{python}: the render server exited unexpectedly; that Python needs numba"
            ) from error
        self._sent, self.failure = layers, str(reply.get("failure", ""))
        if "error" in reply:
            reason = f"could not render the image ({reply['error']})"
            raise StgaError(f"{python}: the render server {reason}")
        return ComposedImage(reply["rgb"], reply["alpha"], reply["depth"] if with_depth else None)

    def _python(self) -> str:
        try:
            return self._find_python()
        except StgaError as error:
            this = f"{sys.executable}, {sys.version.split()[0]}"
            raise StgaError(
                f"Rendering splats needs {' and '.join(missing_packages())} in Blender's own "
                f"Python ({this}), or another Python with them, which is chosen in the add-on's "
                "preferences"
            ) from error


def missing_packages() -> list[str]:
    """Those of REQUIRED_PACKAGES that this interpreter lacks."""
    return [name for name in REQUIRED_PACKAGES if find_spec(name) is None]
