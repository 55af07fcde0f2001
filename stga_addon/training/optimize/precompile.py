"""Compilation of all kernels before the timed part of a training run."""

import subprocess
import time

import numpy as np

from ...avatar.embedding import WORLD
from ...avatar.offsets import OFFSETS
from ...avatar.splats import Splats
from ...capture.camera import Camera
from ...raster.cpu import USES_BUNDLED_KERNELS
from ...raster.cpu.image_loss import change_background
from ...raster.cpu.layout import Parameters
from ...raster.cpu.optimizer import (
    add_screen_gradients,
    distance_limit,
    opacity_weight,
    scale_limit,
)
from ...raster.cpu.precompile import compile_gradients, rasterizer_helper
from ...raster.cpu.rasterize import frames_in_camera, render_backward, render_forward
from ...raster.cpu.threads import start_threads
from ...render.device import adapter_name
from ...worker.launch import is_preparing
from . import adam, driven_offsets
from .losses import image_gradient, whole_image
from .state import TrainState, new_state, with_offsets

HELPER_TIMEOUT_S = 120.0
POLL_INTERVAL_S = 0.05
CAMERA = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))


def precompile_kernels(device: str = "cpu") -> None:
    """Compile what training on a device of `choose_device` runs: the CPU's kernels, which evaluate,
    and the GPU's.

    Each of the former runs once on two splats, with the argument types of real training. If the
    cache is empty, a second process compiles rendering at the same time (`raster.cpu.precompile`).
    While a process compiles
    ahead (`jobs.preparation`), this one waits for it, unless it has kernels that are bundled
    (`raster.cpu.bundled`).
    """
    if not USES_BUNDLED_KERNELS:
        _await_preparation()
    compile_for_cpu()
    if device != "cpu":
        from ...raster.gpu.device import Device
        from ...raster.gpu.optimizer import compile_kernels

        compile_kernels(Device(adapter_name(device)))


def _await_preparation() -> None:
    end = time.monotonic() + HELPER_TIMEOUT_S
    while is_preparing() and time.monotonic() < end:
        time.sleep(POLL_INTERVAL_S)


def compile_for_cpu() -> None:
    """`precompile_kernels` for the CPU, whether or not another process compiles."""
    helper = rasterizer_helper()
    start_threads()
    compile_gradients()
    _limit()
    _optimize()
    if helper is not None:
        try:
            helper.wait(HELPER_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            helper.kill()
    _render()  # loads from the cache what the second process has compiled


def _pair() -> TrainState:
    # Two splats, because a column of a one-row array is contiguous, which is another type to Numba.
    return new_state(
        Splats(
            xyz=np.array([[0, 0, 1], [0, 0, 2]], np.float32),
            rotation=np.array([[1, 0, 0, 0]] * 2, np.float32),
            log_scale=np.full((2, 3), -3, np.float32),
            opacity=np.zeros(2, np.float32),
            sh=np.zeros((2, 16, 3), np.float32),
            face=np.zeros(2, np.int32),
            unbound=np.zeros(2, bool),
        )
    )


def _render() -> None:
    """Forward and backward pass."""
    state = _pair()
    seen, face = frames_in_camera(WORLD, CAMERA), state.face
    rendering = render_forward(state.parameters, face, seen, 3, focus=np.ones(2, bool))
    gradients = state.gradients
    render_backward(
        rendering, state.parameters, face, seen, np.zeros_like(rendering.image), gradients
    )


def _optimize() -> None:
    """Loss and Adam."""
    image, target = np.zeros((3, 16, 16), np.float32), np.zeros((16, 16, 3), np.uint8)
    # like the loader's arrays: read-only arrays are a type of their own
    target.setflags(write=False)
    image_gradient(image, target, whole_image(16, 16), 0.2, np.empty_like(image))
    rates = dict.fromkeys((*Parameters._fields, "sh_rest"), 1e-3)
    state, rows = _pair(), np.arange(2, dtype=np.int32)
    adam.step(state, rows, rates)
    add_screen_gradients(rows, np.zeros(2, np.float32), state.screen_gradient, state.gradient_count)
    offsets = with_offsets(state, OFFSETS, 2).driven_offsets
    driven_offsets.step(
        offsets, rows, state.face, state.gradients.xyz,
        lambda name: np.zeros((2, OFFSETS[name].signals), np.float32), 1e-3, 1.0, adam.EPSILON,
    )  # fmt: skip


def _limit() -> None:
    """Limits, and replacement of the background."""
    state = _pair()
    target, mask = np.zeros((16, 16, 3), np.uint8), np.zeros((16, 16), np.uint8)
    target.setflags(write=False)
    mask.setflags(write=False)
    change_background(
        target, mask, np.zeros(3, np.float32), np.ones(3, np.float32), np.empty_like(target)
    )
    rows = np.arange(2, dtype=np.int32)
    face, unbound = state.face, state.unbound
    # Smaller than the splats: without an excess, its gradient is not computed.
    limits, log_scale = np.full((2, 1), 0.01, np.float32), state.parameters.log_scale
    scale_limit(rows, log_scale, face, unbound, limits, 1.0, state.gradients.log_scale)
    opacity, share = state.parameters.opacity, state.unseen_share
    opacity_weight(rows, opacity, share, 1.0, state.gradients.opacity)
    xyz, gradient = state.parameters.xyz, state.gradients.xyz
    distance_limit(rows, xyz, face, unbound, limits[0], 1.0, gradient)
