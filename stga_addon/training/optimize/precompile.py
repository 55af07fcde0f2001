"""Compilation of all kernels before the timed part of a training run."""

import subprocess
import time

import numpy as np

from ...avatar.embedding import WORLD
from ...avatar.offsets import OFFSETS
from ...avatar.splats import Splats
from ...capture.camera import Camera
from ...raster.cpu import USES_BUNDLED_KERNELS, image_loss, optimizer
from ...raster.cpu.layout import Parameters
from ...raster.cpu.precompile import compile_gradients, rasterizer_helper
from ...raster.cpu.project import count_marked
from ...raster.cpu.rasterize import (
    frames_in_camera,
    moved_frames,
    render_backward,
    render_forward,
)
from ...raster.cpu.threads import ThreadPool
from ...raster.devices import adapter_name
from ...worker.launch import is_preparing
from . import adam
from .image_loss import image_gradient, tile_rectangles, whole_image
from .state import TrainState, new_state, with_offsets

HELPER_TIMEOUT_S = 120.0
POLL_INTERVAL_S = 0.05
CAMERA = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))


def precompile_kernels(device: str = "cpu") -> None:
    """Compile all kernels that a training on this device (`choose_device`) runs.

    The CPU's kernels are always compiled, because evaluations run on the CPU: each runs once on two
    splats, with the argument types of real training. If the cache is empty, a second process
    compiles rendering at the same time (`raster.cpu.precompile`). If another process is already
    compiling ahead (`jobs.compile_ahead`), this one waits for it first, unless kernels are bundled
    (`raster.cpu.bundled`).
    """
    end = time.monotonic() + HELPER_TIMEOUT_S
    while not USES_BUNDLED_KERNELS and is_preparing() and time.monotonic() < end:
        time.sleep(POLL_INTERVAL_S)
    compile_for_cpu()
    if device != "cpu":
        from ...raster.gpu.device import Device
        from ...raster.gpu.optimizer import compile_kernels

        compile_kernels(Device(adapter_name(device)))


def compile_for_cpu() -> None:
    """`precompile_kernels` for the CPU, whether or not another process compiles."""
    helper = rasterizer_helper()
    compile_gradients()
    _step()
    if helper is not None:
        try:
            helper.wait(HELPER_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            helper.kill()
    _render()  # loads from the cache what the second process has compiled


def _render() -> None:
    """Forward and backward pass."""
    state = _two_splats()
    camera_frames = frames_in_camera(WORLD, CAMERA)
    rendering = render_forward(
        state.parameters, state.face, camera_frames, 3, focus=np.ones(2, bool)
    )
    v_image = np.zeros_like(rendering.image)
    render_backward(
        rendering, state.parameters, state.face, camera_frames, v_image, state.gradients
    )


def _step() -> None:
    """Limits, replacement of the background, loss and Adam; and what helpers run."""
    pool = ThreadPool(1)
    pool.start()
    pool.dismiss()
    image = np.zeros((3, 16, 16), np.float32)
    target = np.zeros((16, 16, 3), np.uint8)
    mask = np.zeros((16, 16), np.uint8)
    rows = np.arange(2, dtype=np.int32)
    for loaded in (target, mask):  # read-only arrays are a type of their own
        loaded.setflags(write=False)
    black = np.zeros(3, np.float32)
    white = np.ones(3, np.float32)
    image_loss.change_background(target, mask, black, white, np.empty_like(target))
    state = _two_splats()
    face = state.face
    unbound = state.unbound
    gradients = state.gradients
    xyz, _, log_scale, opacity, *_ = state.parameters
    # Smaller than the splats: without an excess, its gradient is not computed.
    limits = np.full((2, 1), 0.01, np.float32)
    optimizer.scale_limit(rows, log_scale, face, unbound, limits, 1.0, gradients.log_scale)
    optimizer.opacity_weight(rows, opacity, state.unseen_share, 1.0, gradients.opacity)
    optimizer.distance_limit(rows, xyz, face, unbound, limits[0], 1.0, gradients.xyz)
    for rectangles in (whole_image(16, 16), tile_rectangles(np.ones((1, 1), bool), 16, 16)):
        image_gradient(image, target, rectangles, 0.2, np.empty_like(image))
    rates = dict.fromkeys((*Parameters._fields, "sh_rest", "strain_color"), 1e-3)
    adam.step(state, rows, rates)
    screen = state.screen_gradient
    total = state.gradient_count
    optimizer.add_screen_gradients(rows, np.zeros(2, np.float32), screen, total)
    state = with_offsets(state, OFFSETS, 1)
    signal = np.zeros((1, 3), np.float32)
    adam.step_offsets(state, rows, lambda offset: signal, rates, adam.PLAIN)
    coefficients = {name: offset.value for name, offset in state.driven_offsets.items()}
    camera_frames = frames_in_camera(moved_frames(WORLD, coefficients, lambda name: signal), CAMERA)
    counts = np.zeros((2, 2), np.int32)
    count_marked(rows, xyz, face, camera_frames, np.ones((16, 16), bool), *counts)


def _two_splats() -> TrainState:
    # Two, because a column of a one-row array is contiguous, which is another type to Numba.
    shapes = [(2, 3), (2, 4), (2, 3), (2,), (2, 16, 3)]
    xyz, rotation, log_scale, opacity, sh = (np.zeros(shape, np.float32) for shape in shapes)
    xyz[:, 2] = (1, 2)
    rotation[:, 0] = 1
    log_scale[:] = -3
    face = np.zeros(2, np.int32)
    unbound = np.zeros(2, bool)
    return new_state(Splats(xyz, rotation, log_scale, opacity, sh, face, unbound))
