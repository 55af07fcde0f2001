"""Training backend on the CPU (Numba kernels)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from ...avatar.embedding import FaceFrames, frame_backward
from ...avatar.offsets import OFFSETS, POSITION, SCALE, offset_of
from ...capture.model import View
from ...raster.cpu import optimizer, rasterize
from ...raster.cpu.image_loss import LOSS_REACH_PX, change_background
from ...raster.cpu.layout import CameraFrames, Parameters
from ...raster.cpu.optimizer import ColorStep
from ...raster.cpu.threads import threads
from ..settings import TrainingSettings
from . import adam
from .backend import Batch, RenderOptions
from .frames import FrameStore
from .image_loss import image_gradient, tile_rectangles, whole_image
from .state import TrainState, assign_rows, columns_of, keep_rows

WITHOUT_COLOR = RenderOptions(rasterize.BLACK_BACKGROUND, sh_degree=0)


class CpuBackend:
    """Trains in host memory: `state` is the trained arrays, and losses are returned at once."""

    def __init__(self, settings: TrainingSettings, frames: FrameStore, state: TrainState) -> None:
        self.state = state
        self._settings = settings
        self._frames = frames
        self._buffers = rasterize.BufferPool()

    def __len__(self) -> int:
        return len(self.state)

    @cached_property
    def _scale_limits(self) -> np.ndarray:
        # found when a step asks: what only renders does not look through the take for them
        return self._frames.scale_limits(self._settings)

    def step(self, batch: Batch) -> float | None:
        state = self.state
        settings = self._settings
        target = batch.target
        face = state.face
        gradients = state.gradients
        unbound = state.unbound
        focus = None if batch.selected is None else batch.selected.take(face)
        if batch.mask is not None:
            over = self._buffers.get("target", target.shape, np.uint8)
            captured = 255 * np.array(settings.background, np.float32)
            change_background(target, batch.mask, captured, 255 * batch.options.background, over)
            target = over.view()
            target.setflags(write=False)  # like the loader's: Numba compiles for one type only
        frames = self._moved_frames(batch.view.timestep)
        options = adam.adam_options(settings, batch.view.camera)
        color = adam.color_step(state, batch.rates, options, batch.options.sh_degree)
        rows, screen, loss = self._backward(frames, batch.view, target, batch.options, focus, color)
        driving = self._frames.driving(batch.view.timestep)
        # before the limits' gradients are added
        adam.step_offsets(state, rows, driving, batch.rates, options)
        # what keeps splats near what they cover, and unbound ones out of the air
        if settings.scale_weight:
            log_scale = state.parameters.log_scale
            weight = settings.scale_weight
            limits = self._scale_limits
            optimizer.scale_limit(
                rows, log_scale, face, unbound, limits, weight, gradients.log_scale
            )
        if settings.unseen_opacity_weight and state.has_unseen:
            weight = settings.unseen_opacity_weight / len(state)
            fraction = state.unseen_share
            optimizer.opacity_weight(
                rows, state.parameters.opacity, fraction, weight, gradients.opacity
            )
        if settings.distance_weight:
            limit = np.float32(settings.distance_limit) * self._frames.units
            xyz = state.parameters.xyz
            weight = settings.distance_weight
            optimizer.distance_limit(rows, xyz, face, unbound, limit, weight, gradients.xyz)
        adam.step(state, rows, batch.rates, options)
        if batch.accumulate:
            optimizer.add_screen_gradients(
                rows, screen, state.screen_gradient, state.gradient_count
            )
        return loss

    def render(self, view: View, options: RenderOptions) -> np.ndarray:
        frames = self._moved_frames(view.timestep, averaged=True)
        camera_frames = rasterize.frames_in_camera(frames, view.camera, self._buffers)
        return self._forward(self.state.average, camera_frames, options).image.copy()

    def blend_weights(self, view: View) -> np.ndarray:
        frames = self._moved_frames(view.timestep)
        camera_frames = rasterize.frames_in_camera(frames, view.camera, self._buffers)
        rendering = self._forward(self.state.parameters, camera_frames, WITHOUT_COLOR)
        return rasterize.blend_weights(rendering, self._buffers)

    def coefficients(self) -> dict[str, np.ndarray]:
        return {name: offset.value for name, offset in self.state.driven_offsets.items()}

    def columns(
        self, names: Collection[str], rows: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        columns = columns_of(self.state)
        found = {name: columns[name] for name in names}
        return found if rows is None else {name: each.take(rows, 0) for name, each in found.items()}

    def assign(self, rows: np.ndarray, values: Mapping[str, np.ndarray | float]) -> None:
        assign_rows(self.state, rows, values)

    def keep(self, rows: np.ndarray) -> None:
        self.state = keep_rows(self.state, rows)

    def _backward(
        self,
        frames: FaceFrames,
        view: View,
        target: np.ndarray,
        options: RenderOptions,
        focus: np.ndarray | None,
        color: ColorStep | None = None,
    ) -> tuple[np.ndarray, np.ndarray, float | None]:
        """Fill the trained rows' gradients, those of `sh` only where they are not stepped by
        `color`; returns these rows, screen gradients (N,) and loss."""
        weight = self._settings.ssim_weight
        height = view.camera.height
        width = view.camera.width
        state = self.state
        camera_frames = rasterize.frames_in_camera(frames, view.camera, self._buffers)
        rendering = self._forward(state.parameters, camera_frames, options, focus)
        if focus is None:
            key = height, width, threads()
            rectangles = self._buffers.kept("rectangles", key, lambda *key: whole_image(*key[:2]))
        else:
            rectangles = tile_rectangles(rendering.touched, height, width)
        v_image = self._buffers.get("v_image", (3, height, width))
        l1, ssim = image_gradient(rendering.image, target, rectangles, weight, v_image)
        rows, screen = rasterize.render_backward(
            rendering,
            state.parameters,
            state.face,
            camera_frames,
            v_image,
            state.gradients,
            buffers=self._buffers,
            color=color,
        )
        loss = (1 - weight) * l1 + weight * (1 - ssim)
        return rows, screen, loss if focus is None else None

    def _moved_frames(self, timestep: int, averaged: bool = False) -> FaceFrames:
        """Moved by the driven offsets; averaged: by their moving averages."""
        offsets = self.state.driven_offsets.items()
        coefficients = {name: state.average if averaged else state.value for name, state in offsets}
        return self._frames.moved(timestep, coefficients)

    def _forward(
        self,
        splats: Parameters,
        camera_frames: CameraFrames,
        options: RenderOptions,
        focus: np.ndarray | None = None,
    ) -> rasterize.RenderOutput:
        return rasterize.render_forward(
            splats,
            self.state.face,
            camera_frames,
            options.sh_degree,
            options.background,
            focus,
            LOSS_REACH_PX,
            antialiased=self._settings.antialiased,
            buffers=self._buffers,
        )

    def mesh_gradient(
        self,
        shots: Sequence[tuple[View, np.ndarray]],
        weights: Sequence[float],
        options: RenderOptions,
    ) -> tuple[float, np.ndarray]:
        """The weighted sum of the image losses of a timestep's views and images, and its gradient
        (V, 3) with respect to the timestep's mesh; nothing is stepped."""
        store = self._frames
        state = self.state
        timestep = shots[0][0].timestep
        frames = store.of(timestep)
        splats = state.parameters
        face = state.face
        change = {POSITION: np.zeros((len(frames.scale), 3)), SCALE: np.zeros((1, 3))}
        for name, offset in state.driven_offsets.items():
            target = OFFSETS[name].target
            signal = OFFSETS[name].signal
            if target in change:
                more = offset_of(offset.value, store.signals(timestep)(signal))
                change[target] = change[target] + more
        # around the mesh's own origins, in the unit of the scaled frames
        factor = np.exp(change[SCALE][:, :1].astype(np.float64))
        shift = (change[POSITION] / factor).astype(np.float32)
        splats = splats._replace(xyz=splats.xyz + shift[face])
        scaled = replace(frames, scale=frames.scale * factor[:, 0])
        moved = self._moved_frames(timestep)
        total = 0.0
        by_frame = np.zeros((len(frames.scale), 7))
        for (view, image), weight in zip(shots, weights, strict=True):
            rows, _, loss = self._backward(moved, view, image, options, None)
            assert loss is not None
            total += weight * loss
            by_frame += weight * frame_gradient(splats, face, state.gradients, rows, scaled)
        mesh = store.mesh(timestep)
        faces = store.capture.faces
        return total, frame_backward(mesh, faces, frames, by_frame)


def frame_gradient(
    splats: Parameters,
    face: np.ndarray,
    gradients: Parameters,
    rows: np.ndarray,
    frames: FaceFrames,
) -> np.ndarray:
    """(F, 7): gradients of the face frames from those of their splats `rows` (M,), as
    `frame_backward` takes them. A frame moves all its splats alike, so each is a sum over its
    splats."""
    found = np.zeros((len(frames.scale), 7))
    moved = gradients.xyz, gradients.rotation, gradients.log_scale
    optimizer.add_frame_gradients(rows, face, splats.xyz, splats.rotation, *moved, found)
    found[:, :3] /= frames.scale[:, None]
    return found
