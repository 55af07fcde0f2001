"""Training backend on a Warp device: an NVIDIA GPU, or Warp's CPU device for tests."""

import math
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from ...capture.model import View
from ...errors import StgaError
from ...raster.cpu.image_loss import LOSS_REACH_PX
from ...raster.cpu.layout import Parameters
from ...raster.gpu import optimizer
from ...raster.gpu.embed import Embedding
from ...raster.gpu.image_loss import change_background, image_loss_gradient
from ...raster.gpu.rasterize import PARAMETER_TYPES, DeviceFrames, Rasterizer, device_camera
from ...raster.gpu.upload import Uploads
from ..settings import TrainingSettings
from .adam import BETA1, BETA2, EPSILON
from .backend import Batch
from .frames import FrameStore
from .losses import scale_limits
from .state import TrainState


@dataclass(frozen=True)
class _Table:
    """One parameter of all splats on the device: as values (N, D), and as the rasterizer's rows of the same memory."""

    values: wp.array
    rows: wp.array


@dataclass(frozen=True)
class _DeviceState:
    """`TrainState` on the device; a table per parameter."""

    parameters: list[_Table]
    gradients: list[_Table]
    first: list[_Table]
    second: list[_Table]
    average: list[_Table]
    steps: wp.array
    face: wp.array
    unbound: wp.array
    unseen_share: wp.array
    screen_gradient: wp.array
    gradient_count: wp.array


@dataclass(frozen=True)
class _DeviceBatch:
    """A batch with its arrays on the device; slot: index of its loss in `GpuBackend._losses`."""

    batch: Batch
    vertices: wp.array
    target: wp.array
    mask: wp.array | None
    selected: wp.array | None
    slot: int


class GpuBackend:
    """Trains asynchronously: `step` queues an iteration on the device and returns without waiting for it.

    The number of pairs of a splat and a tile becomes known while the iteration runs; the host reads it when it queues
    the next one. If the pairs did not fit into their buffer, the device has left all parameters unchanged, and the
    iteration is queued again. Losses are returned two iterations late.
    """

    def __init__(
        self, device: str, settings: TrainingSettings, units: np.ndarray, frames: FrameStore, state: TrainState
    ) -> None:
        self._settings, self._frames = settings, frames
        capture = frames.capture
        with _memory_errors(device):
            self._rasterizer = Rasterizer(device)
            self._device = self._rasterizer.device
            self._uploads = Uploads(self._device)
            self._embedding = Embedding(
                self._device, capture.neutral, capture.faces, frames.convention, frames.strain
            )  # fmt: skip
            limits = scale_limits(capture, settings), np.float32(settings.distance_limit) * units
            self._scale_limits, self._distance_limit = (
                wp.array(limit, dtype=wp.float32, device=self._device) for limit in limits
            )
            self._losses = wp.zeros(2, wp.float32, device="cpu", pinned=self._device.is_cuda)
        self._queued: _DeviceBatch | None = None
        self._pending: deque[_DeviceBatch] = deque()
        self._slot = 0
        self.state = state

    def __len__(self) -> int:
        return int(self._state.face.size)

    @property
    def state(self) -> TrainState:
        """A copy in host memory, after all queued iterations."""
        self._synchronize()
        state = self._state
        parameters, first, second, average = (
            Parameters(*(_tensor(table.rows) for table in tables))
            for tables in (state.parameters, state.first, state.second, state.average)
        )
        return TrainState(
            parameters=parameters,
            gradients=Parameters(*(torch.zeros_like(tensor) for tensor in parameters)),
            first=first,
            second=second,
            average=average,
            steps=_tensor(state.steps),
            face=_tensor(state.face),
            unbound=_tensor(state.unbound).bool(),
            unseen_share=_tensor(state.unseen_share),
            screen_gradient=_tensor(state.screen_gradient),
            gradient_count=_tensor(state.gradient_count),
        )

    @state.setter
    def state(self, state: TrainState) -> None:
        self._synchronize()

        def tables(tensors: Parameters) -> list[_Table]:
            return [
                _table(tensor.numpy(), kind, self._device)
                for tensor, kind in zip(tensors, PARAMETER_TYPES, strict=True)
            ]

        def array(tensor: torch.Tensor, kind: Any) -> wp.array:
            return wp.array(tensor.numpy(), dtype=kind, device=self._device)

        with _memory_errors(self._device):
            self._state = _DeviceState(
                parameters=tables(state.parameters),
                gradients=tables(state.gradients),
                first=tables(state.first),
                second=tables(state.second),
                average=tables(state.average),
                steps=array(state.steps, wp.int32),
                face=array(state.face, wp.int32),
                unbound=array(state.unbound.to(torch.uint8), wp.uint8),
                unseen_share=array(state.unseen_share, wp.float32),
                screen_gradient=array(state.screen_gradient, wp.float32),
                gradient_count=array(state.gradient_count, wp.float32),
            )

    def step(self, batch: Batch) -> float | None:
        """Queue one step; returns the loss of the iteration before the last if it was a global one."""
        with _memory_errors(self._device):
            self._repeat_if_pairs_overflowed()
            loss = self._finished_loss()
            self._slot = 1 - self._slot
            self._queued = self._upload(batch)
            self._pending.append(self._queued)
            self._enqueue(self._queued)
        return loss

    def render(self, view: View, background: np.ndarray, sh_degree: int) -> np.ndarray:
        """The view with the splats' running average after all queued iterations: a new (3, H, W) float32 image."""
        self._synchronize()
        with _memory_errors(self._device):
            self._uploads.begin()
            vertices = self._upload_mesh(view)
            self._uploads.finish()
            parameters, frames = _rows(self._state.average), self._device_frames(vertices, view, sh_degree)
            return np.array(self._rasterizer.forward(parameters, self._state.face, frames, background).image.numpy())

    def _synchronize(self) -> None:
        """Wait until all queued iterations are done."""
        with _memory_errors(self._device):
            self._repeat_if_pairs_overflowed()
            wp.synchronize_device(self._device)

    def _repeat_if_pairs_overflowed(self) -> None:
        queued, self._queued = self._queued, None
        if queued is not None and not self._rasterizer.pairs_fit():
            self._enqueue(queued)

    def _finished_loss(self) -> float | None:
        """The loss of the oldest pending iteration, which is done when another one has been queued after it."""
        if len(self._pending) < 2:
            return None
        done = self._pending.popleft()
        return float(self._losses.numpy()[done.slot]) / done.target.size if done.selected is None else None

    def _upload(self, batch: Batch) -> _DeviceBatch:
        self._uploads.begin()
        send = self._uploads.send
        uploaded = _DeviceBatch(
            batch=batch,
            vertices=self._upload_mesh(batch.view),
            target=send("target", batch.target, wp.uint8),
            mask=None if batch.mask is None else send("mask", batch.mask, wp.uint8),
            selected=None if batch.selected is None else send("selected", batch.selected, wp.uint8),
            slot=self._slot,
        )
        self._uploads.finish()
        return uploaded

    def _upload_mesh(self, view: View) -> wp.array:
        return self._uploads.send("vertices", self._frames.mesh(view.timestep), wp.vec3d)

    def _device_frames(self, vertices: wp.array, view: View, sh_degree: int) -> DeviceFrames:
        """Face frames in the view's camera."""
        origin, matrix, strain = self._embedding.frames(vertices, view.camera)
        strains = min(strain.shape[1], self._state.parameters[-1].rows.shape[1])
        camera = device_camera(view.camera, sh_degree, strains, antialiased=self._settings.antialiased)
        return DeviceFrames(origin, matrix, strain, camera)

    def _enqueue(self, uploaded: _DeviceBatch) -> None:
        """Queue one iteration."""
        rasterizer, state, batch = self._rasterizer, self._state, uploaded.batch
        focus = None
        if uploaded.selected is not None:
            focus = rasterizer.buffers.get("focus", len(self), wp.uint8)
            rasterizer.launch(optimizer.mark_focus, len(self), state.face, uploaded.selected, focus)
        parameters, gradients = _rows(state.parameters), _rows(state.gradients)
        frames = self._device_frames(uploaded.vertices, batch.view, batch.sh_degree)
        rendering = rasterizer.forward(
            parameters, state.face, frames, batch.background, focus, LOSS_REACH_PX, wait=False
        )  # fmt: skip
        v_image, loss = image_loss_gradient(rasterizer, rendering, self._target(uploaded), self._settings.ssim_weight)
        screen = rasterizer.backward(rendering, parameters, state.face, v_image, gradients)
        self._add_limit_gradients(rendering.wanted)
        self._adam(rendering.wanted, batch.rates)
        if batch.accumulate:
            rasterizer.launch(
                optimizer.accumulate_screen_gradient,
                len(self),
                rendering.wanted,
                screen,
                state.screen_gradient,
                state.gradient_count,
            )
        if uploaded.selected is None:
            total = rasterizer.buffers.get("loss_sum", 1)
            wp.utils.array_sum(loss.flatten(), out=total)
            wp.copy(self._losses, total, dest_offset=uploaded.slot, count=1)

    def _target(self, uploaded: _DeviceBatch) -> wp.array:
        """The target over the batch's background."""
        if uploaded.mask is None:
            return uploaded.target
        out = self._rasterizer.buffers.get("over", uploaded.target.shape, wp.uint8)
        change = 255 * uploaded.batch.background - 255 * np.array(self._settings.background, np.float32)
        self._rasterizer.launch(
            change_background,
            uploaded.mask.shape,
            uploaded.target,
            uploaded.mask,
            wp.vec3(*(float(c) for c in change)),
            out,
        )
        return out

    def _add_limit_gradients(self, wanted: wp.array) -> None:
        """Add the gradients of the limits that keep splats near what they cover."""
        settings, state, launch, n = self._settings, self._state, self._rasterizer.launch, len(self)
        squares, square = self._rasterizer.buffers.get("squares", n), self._rasterizer.buffers.get("square", 1)
        xyz, log_scale = _rows(state.parameters).xyz, _rows(state.parameters).log_scale
        if settings.scale_weight:
            given = wanted, state.unbound, log_scale, state.face, self._scale_limits
            launch(optimizer.scale_excess, n, *given, squares)
            wp.utils.array_sum(squares, out=square)
            launch(optimizer.scale_limit, n, *given, settings.scale_weight, square, _rows(state.gradients).log_scale)
        if settings.unseen_opacity_weight:
            opacity, gradient = _rows(state.parameters).opacity, _rows(state.gradients).opacity
            weight = settings.unseen_opacity_weight / n
            launch(optimizer.opacity_weight, n, wanted, opacity, state.unseen_share, weight, gradient)
        if settings.distance_weight:
            given = wanted, state.unbound, xyz, state.face, self._distance_limit
            launch(optimizer.distance_excess, n, *given, squares)
            wp.utils.array_sum(squares, out=square)
            launch(optimizer.distance_limit, n, *given, settings.distance_weight, square, _rows(state.gradients).xyz)

    def _adam(self, wanted: wp.array, rates: Mapping[str, float]) -> None:
        state, launch = self._state, self._rasterizer.launch
        correct = self._rasterizer.buffers.get("correct", len(self), wp.vec3)
        logarithms = math.log(BETA1), math.log(BETA2)
        launch(optimizer.count_steps, len(self), wanted, *logarithms, self._settings.ema_share, state.steps, correct)
        for name, *tables in zip(
            Parameters._fields, state.parameters, state.gradients, state.first, state.second, state.average, strict=True
        ):
            values = [table.values for table in tables]
            rest, rate_rest = (3, rates["sh_rest"]) if name == "sh" else (values[0].shape[1], 0.0)
            launch(
                optimizer.adam, values[0].shape, wanted, correct, *values, rates[name], rate_rest, rest,
                float(BETA1), float(BETA2), float(EPSILON),
            )  # fmt: skip


def _rows(tables: list[_Table]) -> Parameters:
    return Parameters(*(table.rows for table in tables))


def _table(values: np.ndarray, kind: Any, device: wp.Device) -> _Table:
    flat = wp.array(values.reshape(len(values), math.prod(values.shape[1:])), dtype=wp.float32, device=device)
    shape = values.shape if kind is wp.float32 else values.shape[:-1]
    if not values.size:
        return _Table(flat, wp.empty(shape, kind, device=device))
    return _Table(flat, wp.array(ptr=flat.ptr, dtype=kind, shape=shape, device=device))


def _tensor(array: wp.array) -> torch.Tensor:
    """A copy in host memory."""
    return torch.from_numpy(np.array(array.numpy()))


@contextmanager
def _memory_errors(device: wp.Device | str) -> Iterator[None]:
    """Turn a failed allocation on the device into a StgaError."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, RuntimeError) and "allocate" not in str(error):
            raise
        raise StgaError(
            f"--device cuda: the memory of {device} is full; close other programs that use it, train smaller images or "
            "fewer splats, or give --device cpu"
        ) from error
