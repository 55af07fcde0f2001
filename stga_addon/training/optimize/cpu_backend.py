"""One iteration on the CPU, with Numba's kernels."""

import numpy as np

from ...avatar.embedding import frame_backward
from ...capture.model import View
from ...raster.cpu.image_loss import change_background
from ...raster.cpu.optimizer import distance_limit, scale_limit
from ...raster.cpu.rasterize import (
    BufferPool,
    Parameters,
    RenderOutput,
    frames_in_camera,
    render_backward,
    render_forward,
)
from ..settings import TrainingSettings
from . import adam
from .backend import Batch
from .frames import FrameStore
from .losses import LOSS_REACH_PX, image_gradient, tile_rectangles, whole_image
from .state import TrainState
from .tracking import frame_gradient


class CpuBackend:
    """Trains in the host's memory: `state` is the splats themselves, and every loss is told at once."""

    def __init__(self, settings: TrainingSettings, lengths: np.ndarray, frames: FrameStore, state: TrainState) -> None:
        self.state = state
        self._settings, self._lengths, self._frames = settings, lengths, frames
        self._buffers = BufferPool()

    def __len__(self) -> int:
        return len(self.state)

    def train(self, batch: Batch) -> float | None:
        """Make one step; returns the image loss of a global iteration, None of a local one."""
        state = self.state
        focus = None if batch.selected is None else batch.selected[state.face.numpy()]
        rows, screen, loss = self._differentiate(batch.view, self._over(batch), batch.background, batch.degree, focus)
        if batch.refine:
            self._refine(batch, rows)
        self._limit(rows)
        adam.step(state, rows, batch.rates, self._settings.ema_share)
        if focus is None:
            state.screen_gradient.numpy()[rows] += screen[rows]
            state.gradient_count.numpy()[rows] += 1
        return loss

    def render(self, view: View, background: np.ndarray, degree: int) -> np.ndarray:
        """The view as the splats' running average shows it: a new (3, H, W) float32 image."""
        average = Parameters(*(tensor.numpy() for tensor in self.state.average))
        return self._render(average, view, background, degree).image.copy()

    def _over(self, batch: Batch) -> np.ndarray:
        """The target over the background that is drawn behind the splats."""
        if batch.mask is None:
            return batch.target
        over = self._buffers.get("target", batch.target.shape, np.uint8)
        before = np.array(self._settings.background, np.float32)
        change_background(batch.target, batch.mask, 255 * before, 255 * batch.background, over)
        read_only = over.view()
        read_only.setflags(write=False)  # as the loader's are: one type, compiled once
        return read_only

    def _differentiate(
        self, view: View, target: np.ndarray, background: np.ndarray, degree: int, focus: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, float | None]:
        """Fill the gradients of the rows that matter; returns those rows, their screen pull and the loss."""
        weight, height, width = self._settings.ssim_weight, view.camera.height, view.camera.width
        rendering = self._render(self.state.arrays(), view, background, degree, focus)
        rectangles = whole_image(height, width) if focus is None else tile_rectangles(rendering.touched, height, width)
        v_image = self._buffers.get("v_image", (3, height, width))
        l1, ssim = image_gradient(rendering.image, target, rectangles, weight, v_image)
        rows, screen = render_backward(
            rendering, self.state.arrays(), self.state.face.numpy(), self._seen, v_image,
            Parameters(*(g.numpy() for g in self.state.gradients)), buffers=self._buffers,
        )  # fmt: skip
        loss = (1 - weight) * l1 + weight * (1 - ssim)
        return rows, screen, loss if focus is None else None

    def _render(
        self, splats: Parameters, view: View, background: np.ndarray, degree: int, focus: np.ndarray | None = None
    ) -> RenderOutput:
        self._seen = frames_in_camera(self._frames.of(view.timestep), view.camera)
        return render_forward(
            splats, self.state.face.numpy(), self._seen, degree, background, focus, LOSS_REACH_PX,
            antialiased=self._settings.antialiased, buffers=self._buffers,
        )  # fmt: skip

    def _refine(self, batch: Batch, rows: np.ndarray) -> None:
        """Backend FLAME's parameters of the timestep along the gradient of the loss, which the splats' rows hold."""
        store, state, timestep = self._frames, self.state, batch.view.timestep
        assert store.tracking is not None  # nobody else asks for it
        frames, gradients = store.of(timestep), Parameters(*(g.numpy() for g in state.gradients))
        asked = frame_gradient(state.arrays(), state.face.numpy(), gradients, rows, frames)
        pull = frame_backward(store.mesh(timestep), store.capture.faces, frames, *asked)
        store.tracking.step(timestep, pull, batch.refine)
        store.forget()

    def _limit(self, rows: np.ndarray) -> None:
        """Add the gradients of the limits that keep splats near what they cover."""
        settings, state = self._settings, self.state
        face, unbound = state.face.numpy(), state.unbound.numpy()
        if settings.scale_weight:
            limit = np.float32(settings.scale_limit) * self._lengths
            gradient = state.gradients.log_scale.numpy()
            scale_limit(rows, state.parameters.log_scale.numpy(), face, unbound, limit, settings.scale_weight, gradient)
        if settings.distance_weight:
            limit = np.float32(settings.distance_limit) * self._lengths
            gradient = state.gradients.xyz.numpy()
            distance_limit(rows, state.parameters.xyz.numpy(), face, unbound, limit, settings.distance_weight, gradient)
