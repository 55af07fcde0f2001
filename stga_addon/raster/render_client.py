"""Who draws: this process where it can, else a worker in another interpreter. Importing this needs numpy alone."""

import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from typing import IO, Any, cast

import numpy as np

from ..capture.camera import Camera
from ..errors import StgaError
from ..worker.launch import start_python
from .posed_splats import ComposedImage, PosedSplats
from .render_protocol import pack_layers, receive, send

REQUIRED_PACKAGES = ("numba", "platformdirs")
"""What drawing needs beside numpy, as pip calls it."""


class RenderClient:
    """Draws layers, from any thread, one picture at a time.

    find_python: the interpreter that draws where this one lacks REQUIRED_PACKAGES; raises StgaError where there is
    none.
    """

    def __init__(self, find_python: Callable[[], str]) -> None:
        self._find_python = find_python
        self._lock = threading.Lock()
        self._worker: tuple[str, subprocess.Popen[bytes]] | None = None
        self._sent: Sequence[PosedSplats] | None = None

    def compose(self, layers: Sequence[PosedSplats], camera: Camera, with_depth: bool = False) -> ComposedImage:
        """`compose.compose`, here or in the worker. Raises StgaError where neither can draw."""
        with self._lock:
            if not missing_packages():
                from .cpu.compose import compose

                return compose(layers, camera, with_depth)
            return self._ask(layers, camera, with_depth)

    def close(self) -> None:
        """End the worker, if there is one; the next picture starts another."""
        begun, self._worker, self._sent = self._worker, None, None
        if begun is not None:
            _, worker = begun
            worker.kill()
            worker.wait()
            for pipe in (worker.stdin, worker.stdout):
                with suppress(OSError):  # what was still to be sent to one that is gone
                    cast(IO[bytes], pipe).close()

    def _ask(self, layers: Sequence[PosedSplats], camera: Camera, with_depth: bool) -> ComposedImage:
        python, worker = self._worker or self._start()
        requests, answers = cast(IO[bytes], worker.stdin), cast(IO[bytes], worker.stdout)
        size = [camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy]
        request: dict[str, Any] = {"camera": np.array(size), "pose": camera.world_to_camera, "with_depth": with_depth}
        if layers is not self._sent:
            request |= pack_layers(layers)
        try:
            send(requests, request)
            answer = receive(answers)
        except (OSError, EOFError) as error:
            self.close()
            raise StgaError(f"{python}: drawing ended with its worker; is numba installed there?") from error
        self._sent = layers
        if "error" in answer:
            raise StgaError(f"{python}: could not draw ({answer['error']})")
        return ComposedImage(answer["rgb"], answer["alpha"], answer["depth"] if with_depth else None)

    def _start(self) -> tuple[str, subprocess.Popen[bytes]]:
        python = self._python()
        worker = start_python(
            python, ["stga_addon.raster.render_server"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._worker = python, worker
        return self._worker

    def _python(self) -> str:
        try:
            return self._find_python()
        except StgaError as error:
            own = f"{sys.executable}, {sys.version.split()[0]}"
            raise StgaError(
                f"drawing splats needs {' and '.join(missing_packages())} in Blender's own Python ({own}), "
                "or a training environment, which the add-on's preferences or `stga environment` make or choose"
            ) from error


def missing_packages() -> list[str]:
    """The packages of REQUIRED_PACKAGES that this interpreter lacks."""
    return [name for name in REQUIRED_PACKAGES if find_spec(name) is None]
