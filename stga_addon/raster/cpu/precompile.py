"""Compilation of the rasterizer's kernels in two processes: rendering in a second one, gradients in
the first.

Numba compiles one function at a time per process. The second process needs no torch, so it starts
at once.
"""

import os
import subprocess
import sys
from contextlib import suppress
from functools import cache

import numpy as np

from ...avatar.embedding import WORLD
from ...capture.camera import Camera
from ...worker.launch import end_with_this_process, is_preparing, same_interpreter_environment
from ..kernel_cache import has_kernels
from . import KERNEL_CACHE_FOLDER, rasterize
from .bundled import PACKAGE
from .layout import CameraFrames, Parameters, TileLists

SIZE = 16
"""Width and height of the image, in pixels: one tile."""


def begin_compiling() -> None:
    """Compile rendering in a second process, while this one does something else."""
    if not is_preparing():
        rasterizer_helper()


@cache
def rasterizer_helper() -> "subprocess.Popen[bytes] | None":
    """The process that runs `compile_rendering`, started by the first call; None if the kernels are
    cached already or a second process would not help.
    """
    is_whole = __name__.startswith(f"{PACKAGE}.")
    if has_kernels(KERNEL_CACHE_FOLDER) or (os.cpu_count() or 1) < 2 or not is_whole:
        return None
    code = f"from {__name__} import compile_rendering; compile_rendering()"
    with suppress(OSError):
        return subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=same_interpreter_environment(os.environ),
            preexec_fn=end_with_this_process(),
        )
    return None


def compile_rendering() -> None:
    """Compile `render_forward` with the types of real training."""
    rasterize.render_forward(*_two_splats(), 3, focus=np.ones(2, bool))


def compile_gradients() -> None:
    """Compile `render_backward` with the types of real training; nothing has to be rendered
    before."""
    none = np.zeros(0, np.int32)
    by_splat = np.zeros(2, np.int32)
    tile = np.zeros(1, np.int32)
    lists = TileLists(
        np.arange(2, dtype=np.int32), by_splat, by_splat, none, np.zeros(2, np.int64), none
    )
    buffers = rasterize.BufferPool()
    (splats, face, frames) = _two_splats()
    output = rasterize.RenderOutput(
        rasterize.new_image(SIZE, SIZE, lists, buffers),
        rasterize.new_projection(2, buffers),
        lists,
        tile,
        tile_blocks=np.zeros(1, np.uint16),
        focus=np.ones(2, bool),
        touched=np.ones((1, 1), bool),
        background=rasterize.BLACK_BACKGROUND,
        degree=3,
        depth_as_color=False,
        antialiased=False,
    )
    v_image = np.zeros((3, SIZE, SIZE), np.float32)
    rasterize.render_backward(output, splats, face, frames, v_image, splats)


def _two_splats() -> tuple[Parameters, np.ndarray, CameraFrames]:
    """Two in one tile, one behind the other, so that they are sorted; a column of a one-row array
    would be contiguous, which is another type to Numba."""
    shapes = (2, 3), (2, 4), (2, 3), (2,), (2, 16, 3)
    splats = Parameters(*(np.zeros(shape, np.float32) for shape in shapes))
    splats.xyz[:, 2] = (1, 2)
    splats.rotation[:, 0] = 1
    splats.log_scale[:] = -3
    frames = rasterize.frames_in_camera(WORLD, Camera(SIZE, SIZE, 16.0, 16.0, 8.0, 8.0, np.eye(4)))
    return splats, np.zeros(2, np.int32), frames
