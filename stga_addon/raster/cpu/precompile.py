"""Compilation of the kernels that blend, which take about half of the time, in a second process.

Numba compiles one function at a time per process. The second process needs no torch, so it starts at once.
"""

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np

from ...worker.cache import has_kernels, is_preparing
from ...worker.launch import end_with_this_process, same_interpreter_environment
from . import KERNEL_CACHE_FOLDER
from .blend import blend_backward, blend_forward
from .layout import PROJECTED, TileLists
from .rasterize import BLACK_BACKGROUND, BufferPool, new_image, new_projection, tile_grid

PACKAGE = "stga_addon"
SIZE = 16
"""Width and height of the image, in pixels: one tile."""


def begin_compiling() -> None:
    """Compile the kernels that blend in a second process, while this one does something else."""
    if not is_preparing():
        blending_helper()


@cache
def blending_helper() -> "subprocess.Popen[bytes] | None":
    """The process that runs `compile_blending`, started by the first call; None if the kernels are cached already or a
    second process would not help.
    """
    # As part of an extension, the package has another name and another cache.
    if has_kernels(Path(KERNEL_CACHE_FOLDER)) or (os.cpu_count() or 1) < 2 or not __name__.startswith(f"{PACKAGE}."):
        return None
    try:
        return subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import compile_blending; compile_blending()"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=same_interpreter_environment(os.environ),
            preexec_fn=end_with_this_process(),
        )
    except OSError:
        return None


def compile_blending() -> None:
    """Compile `blend_forward` and `blend_backward` on an image without splats, with the types of real training."""
    none, buffers = np.zeros(0, np.int32), BufferPool()
    tiles_x, tiles_y = tile_grid(SIZE, SIZE)
    tiles = np.arange(tiles_x * tiles_y, dtype=np.int32)
    lists = TileLists(none, none, none, none, np.zeros(len(tiles) + 1, np.int64), none)
    projection = new_projection(2, buffers)  # a column of a one-row array is contiguous, which is another type to Numba
    blended = new_image(SIZE, SIZE, lists, buffers)
    blend_forward(tiles, tiles_x, lists, projection, BLACK_BACKGROUND, blended)
    v_image = np.zeros((3, SIZE, SIZE), np.float32)
    blend_backward(
        tiles, tiles_x, lists, blended, np.ones(2, bool), projection.columns, BLACK_BACKGROUND, v_image,
        np.zeros((SIZE, SIZE), np.float32), np.zeros((0, PROJECTED), np.float32),
    )  # fmt: skip
