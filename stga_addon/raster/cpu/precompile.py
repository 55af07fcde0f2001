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
from . import KERNEL_CACHE_FOLDER
from .blend import blend_backward, blend_forward
from .bundled import PACKAGE
from .layout import PROJECTED, CameraFrames, Parameters, TileLists
from .project import project_backward, project_forward
from .rasterize import (
    BLACK_BACKGROUND,
    BufferPool,
    frames_in_camera,
    new_image,
    new_projection,
    sort_by_depth,
    sort_into_tiles,
    tile_grid,
    with_strain_color,
)  # fmt: skip
from .tiles import find_needed_rows, split_splats, sum_tiles, whole_tiles

SIZE = 16
"""Width and height of the image, in pixels: one tile."""
SHAPES = ((3,), (4,), (3,), (), (16, 3))
"""Of a splat's `Parameters`."""


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
    buffers, (tiles_x, tiles_y) = BufferPool(), tile_grid(SIZE, SIZE)
    tiles = np.arange(tiles_x * tiles_y, dtype=np.int32)
    everywhere = sum_tiles(np.ones((tiles_y, tiles_x), bool))
    splats, face, frames = _two_splats()
    projection = new_projection(2, buffers)
    project_forward(np.arange(2), everywhere, splats, face, frames, 3, False, False, projection)
    projection.rect[:] = 0
    split_splats(np.ones(2, bool))
    find_needed_rows(projection, np.arange(2), np.float32(0), tiles_x, tiles_y)
    # in one tile, behind each other: sorted
    projection.rect[:, 2:], projection.depth[:] = 1, (1, 2)
    sort_by_depth(projection, buffers)
    projection.rect[:] = 0
    lists, _ = sort_into_tiles(projection, tiles_x, whole_tiles(len(tiles)), buffers)
    blended = new_image(SIZE, SIZE, lists, buffers)
    blend_forward(
        tiles, tiles_x, whole_tiles(len(tiles)), lists, projection, BLACK_BACKGROUND, blended
    )


def compile_gradients() -> None:
    """Compile `render_backward` with the types of real training; nothing has to be rendered
    before."""
    buffers, (tiles_x, tiles_y) = BufferPool(), tile_grid(SIZE, SIZE)
    splats, face, frames = _two_splats()
    tiles, projection = np.arange(tiles_x * tiles_y, dtype=np.int32), new_projection(2, buffers)
    none, by_splat = np.zeros(0, np.int32), np.zeros(2, np.int32)
    lists = TileLists(none, by_splat, by_splat, none, np.zeros(len(tiles) + 1, np.int64), none)
    v_image = np.zeros((3, SIZE, SIZE), np.float32)
    v_transmittance = np.zeros((SIZE, SIZE), np.float32)
    pair_gradients = buffers.get("pair_gradients", (0, PROJECTED))
    blend_backward(
        tiles, tiles_x, lists, new_image(SIZE, SIZE, lists, buffers), np.ones(2, bool),
        projection.columns, BLACK_BACKGROUND, v_image, v_transmittance, pair_gradients,
    )  # fmt: skip
    projection.columns[:] = 1
    # Without rows, no kernel is called: two, each of no pair.
    project_backward(
        np.arange(2, dtype=np.int32), splats, face, frames, 3, False, False, projection.columns,
        lists, pair_gradients, splats, buffers.get("screen_gradient", (2,)),
    )  # fmt: skip


def _two_splats() -> tuple[Parameters, np.ndarray, CameraFrames]:
    # That no tile contains; two, because a column of a one-row array is contiguous, which is
    # another type to Numba.
    splats = with_strain_color(Parameters(*(np.zeros((2, *shape), np.float32) for shape in SHAPES)))
    frames = frames_in_camera(WORLD, Camera(SIZE, SIZE, 16.0, 16.0, 8.0, 8.0, np.eye(4)))
    return splats, np.zeros(2, np.int32), frames
