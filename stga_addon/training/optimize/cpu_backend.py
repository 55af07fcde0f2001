"""Training backend on the CPU (Numba kernels), and its image loss (STGA, training)."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np

from ...avatar.embedding import FaceFrames, frame_backward
from ...avatar.offsets import OFFSETS, POSITION, SCALE, offset_of
from ...capture.model import View
from ...raster.cpu import optimizer, rasterize
from ...raster.cpu.image_loss import LOSS_REACH_PX, add_up, change_background, image_loss
from ...raster.cpu.layout import TILE, Parameters
from ...raster.cpu.threads import threads
from ...raster.cpu.tiles import box_groups
from ..settings import TrainingSettings
from . import adam
from .frames import FrameStore
from .state import Batch, TrainState

BAND_TILES = 4
"""Most rows of tiles in a rectangle of a local iteration; each computes 20 rows of pixels more."""


@cache
def _bands(height: int, count: int) -> int:
    """How many bands cost the busiest of `count` threads the fewest rows."""
    fewest = -(-count // 2)
    most = 2 * count
    beyond = 2 * LOSS_REACH_PX
    return min(
        range(fewest, most + 1), key=lambda n: -(-3 * n // count) * (-(-height // n) + beyond)
    )


def whole_image(height: int, width: int, bands: int | None = None) -> np.ndarray:
    """Rectangles (R, 4) of pixels x0, y0, x1, y1 that tile an image; each channel of one is one
    thread's work. bands: how many, over the whole width, because pixels beyond left and right edges
    cost more; by default, so many that the threads are done soonest."""
    count = min(bands or _bands(height, threads()), height)
    tops = [height * n // count for n in range(count + 1)]
    return np.array([[0, y0, width, y1] for y0, y1 in pairwise(tops)], np.int64)


def tile_rectangles(tiles: np.ndarray, height: int, width: int) -> np.ndarray:
    """Rectangles (R, 4) of pixels around each connected group of marked tiles (rows, columns) bool,
    the largest first; those of more than BAND_TILES rows are cut, for the threads."""
    return np.minimum(box_groups(tiles, BAND_TILES) * TILE, [width, height, width, height])


def image_gradient(
    image: np.ndarray,
    target: np.ndarray,
    rectangles: np.ndarray,
    ssim_weight: float,
    out: np.ndarray,
) -> tuple[float, float]:
    """Write the gradient of (1 − w)·L1 + w·(1 − SSIM) with respect to the image into `out`, within
    the rectangles; of means over the whole image. Returns L1 and SSIM within the rectangles.

    image, out (3, H, W) float32; target (H, W, 3) uint8.
    """
    sums = np.zeros((2, 3, sum(y1 - y0 for _, y0, _, y1 in rectangles.tolist())))
    share = 1.0 / image.size
    image_loss(image, target, rectangles, np.float32(ssim_weight), np.float32(share), out, sums)
    l1, ssim = add_up(sums)
    return l1 * share, ssim * share


def mean_ssim(image: np.ndarray, target: np.ndarray) -> float:
    """Mean SSIM of image (3, H, W) float32 and target (H, W, 3) uint8."""
    unused = np.empty_like(image)
    _, height, width = image.shape
    return image_gradient(image, target, whole_image(height, width), 1.0, unused)[1]


class CpuBackend:
    """Trains in host memory: `state` is the trained arrays, and losses are returned at once."""

    def __init__(self, settings: TrainingSettings, frames: FrameStore, state: TrainState) -> None:
        self.state = state
        self._settings = settings
        self._frames = frames
        self._scale_limits = frames.scale_limits(settings)
        self._buffers = rasterize.BufferPool()

    def __len__(self) -> int:
        return len(self.state)

    def step(self, batch: Batch) -> float | None:
        """Forward, backward, optimizer; returns the image loss, None of a local iteration."""
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
            change_background(target, batch.mask, captured, 255 * batch.background, over)
            target = over.view()
            target.setflags(write=False)  # like the loader's: Numba compiles for one type only
        rows, screen, loss = self._backward(
            self._moved_frames(batch.view.timestep),
            batch.view,
            target,
            batch.background,
            batch.sh_degree,
            focus,
        )
        options = adam.adam_options(settings, batch.view.camera)
        signals = self._frames.signals(batch.view.timestep)
        # before the limits' gradients are added
        adam.step_offsets(state, rows, signals, batch.rates, options)
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
            share = state.unseen_share
            optimizer.opacity_weight(
                rows, state.parameters.opacity, share, weight, gradients.opacity
            )
        if settings.distance_weight:
            limit = np.float32(settings.distance_limit) * self._frames.units
            xyz = state.parameters.xyz
            weight = settings.distance_weight
            optimizer.distance_limit(rows, xyz, face, unbound, limit, weight, gradients.xyz)
        adam.step(state, rows, batch.rates, options, batch.sh_degree)
        if batch.accumulate:
            optimizer.add_screen_gradients(
                rows, screen, state.screen_gradient, state.gradient_count
            )
        return loss

    def render(self, view: View, background: np.ndarray, sh_degree: int) -> np.ndarray:
        """The view with the splats' exponential moving average: a new (3, H, W) float32 image."""
        frames = self._moved_frames(view.timestep, averaged=True)
        return self._forward(self.state.average, frames, view, background, sh_degree).image.copy()

    def _backward(
        self,
        frames: FaceFrames,
        view: View,
        target: np.ndarray,
        background: np.ndarray,
        sh_degree: int,
        focus: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray, float | None]:
        """Fill the trained rows' gradients; returns these rows, screen gradients (N,) and loss."""
        weight = self._settings.ssim_weight
        height = view.camera.height
        width = view.camera.width
        state = self.state
        rendering = self._forward(state.parameters, frames, view, background, sh_degree, focus)
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
            self._frames_in_camera,
            v_image,
            state.gradients,
            buffers=self._buffers,
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
        frames: FaceFrames,
        view: View,
        background: np.ndarray,
        sh_degree: int,
        focus: np.ndarray | None = None,
    ) -> rasterize.RenderOutput:
        self._frames_in_camera = rasterize.frames_in_camera(frames, view.camera)
        return rasterize.render_forward(
            splats,
            self.state.face,
            self._frames_in_camera,
            sh_degree,
            background,
            focus,
            LOSS_REACH_PX,
            antialiased=self._settings.antialiased,
            buffers=self._buffers,
        )

    def mesh_gradient(
        self,
        shots: Sequence[tuple[View, np.ndarray]],
        weights: Sequence[float],
        background: np.ndarray,
        sh_degree: int,
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
        growth = np.exp(change[SCALE][:, :1].astype(np.float64))
        shift = (change[POSITION] / growth).astype(np.float32)
        splats = splats._replace(xyz=splats.xyz + shift[face])
        scaled = replace(frames, scale=frames.scale * growth[:, 0])
        moved = self._moved_frames(timestep)
        total = 0.0
        by_frame = np.zeros((len(frames.scale), 7))
        for (view, image), weight in zip(shots, weights, strict=True):
            rows, _, loss = self._backward(moved, view, image, background, sh_degree, None)
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
