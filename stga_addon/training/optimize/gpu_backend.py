"""Training backend on a GPU, by WebGPU kernels."""

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...capture.model import View
from ...raster.cpu.image_loss import LOSS_REACH_PX
from ...raster.gpu import optimizer, rasterize
from ...raster.gpu.device import Device, Readback, Recording
from ...raster.gpu.frames import Embedding
from ...raster.gpu.layout import COUNTS, NEEDED, OVERFLOWED, splat_rows, split_rows
from ...raster.gpu.optimizer import OffsetTables, OptimizerTables, image_loss, upload_target
from ..settings import TrainingSettings
from .adam import adam_options
from .backend import Batch, RenderOptions
from .cpu_backend import CpuBackend
from .frames import FrameStore
from .state import (
    Halving,
    OffsetState,
    TrainState,
    arrays_of,
    assign_rows,
    keep_rows,
    with_halves,
)

QUEUED_ITERATIONS = 2
"""Iterations that the device may be behind; losses are returned as many iterations late."""
TABLES = ("gradients", "first", "second", "average")
"""Tables of a `TrainState` beside the splats, each shaped as the splats."""


@dataclass
class _Queued:
    """An iteration on its way, with its batch in case it is repeated; loss: of a global one."""

    batch: Batch
    readback: Readback
    done: bool = False
    loss: float | None = None


class GpuBackend:
    """Trains asynchronously: `step` records an iteration, submits it at once and returns without
    waiting for it.

    How many (tile, splat) pairs there are only the device knows. Where they exceed the buffers, it
    changes nothing from there on; the host learns it when it reads that iteration's loss, makes
    room, and queues what was left out again.

    Between steps, rows are edited in a copy in host memory, which the next step or picture uploads.
    """

    def __init__(
        self, device: Device, settings: TrainingSettings, frames: FrameStore, state: TrainState
    ) -> None:
        capture = frames.capture
        self._settings = settings
        self._frames = frames
        self.device = device
        self._rasterizer = rasterize.Rasterizer(device)
        self._embedding = Embedding(
            device, capture.neutral, capture.faces, frames.convention, frames.strain
        )
        self._triangles = len(capture.faces)
        distance_limits = settings.distance_limit * frames.units
        self._limits = np.column_stack([*frames.scale_limits(settings), distance_limits])
        self._edited: TrainState | None = None
        self._is_changed = False
        self._pending: deque[_Queued] = deque()
        self._readbacks = [Readback(device, COUNTS + 1) for _ in range(QUEUED_ITERATIONS)]
        self._rasterizer.make_room(0)
        optimizer.compile_kernels(device)
        self.state = state

    def __len__(self) -> int:
        return self._splats.count if self._edited is None else len(self._edited)

    @property
    def state(self) -> TrainState:
        self._finish_all()
        self._upload_edited()
        count = len(self)
        stride = self._splats.stride
        coefficients = self._splats.coefficients
        read = self.device.read
        buffer = self.device.buffer
        tables = [
            split_rows(read(buffer(name, 0), (count, stride)), coefficients)
            for name in ("splats", *TABLES)
        ]
        history = read(self._tables.history, (count, 3), np.uint32)
        traits = read(self._tables.traits, (count, 2))
        sums = history.view(np.float32)
        offsets = {}
        for name, each in self._offsets.items():
            shape = self._triangles, 3, 3
            parts = (each.coefficients, each.first, each.second, each.average)
            value, first, second, average = (read(part, shape) for part in parts)
            steps = read(each.steps, (self._triangles,), np.int32)
            offsets[name] = OffsetState(value, first, second, average, steps)
        parameters, gradients, *moments, mean = tables
        return TrainState(
            parameters,
            gradients,
            moments[0],
            moments[1],
            mean,
            history[:, 0].astype(np.int32),
            read(self._splats.face, (count,), np.int32),
            traits[:, 0] > 0,
            traits[:, 1].copy(),
            sums[:, 1].copy(),
            sums[:, 2].copy(),
            offsets,
        )

    @state.setter
    def state(self, state: TrainState) -> None:
        self._finish_all()
        self._edited = None
        self._is_changed = False
        upload = self.device.upload
        rows = {name: upload(name, splat_rows(getattr(state, name))) for name in TABLES}
        self._gradients = rows.pop("gradients")
        sums = (state.screen_gradient.view(np.uint32), state.gradient_count.view(np.uint32))
        history = np.stack([state.steps.astype(np.uint32), *sums], axis=1)
        traits = np.stack([state.unbound, state.unseen_share], axis=1, dtype=np.float32)
        self._tables = OptimizerTables(
            **rows,
            history=upload("history", history),
            traits=upload("traits", traits),
            limits=upload("limits", self._limits.astype(np.float32)),
        )
        self._splats = rasterize.upload_splats(self.device, state.parameters, state.face)
        by_triangle = optimizer.splats_by_triangle(state.face, self._triangles)
        splats_of = upload("splats by triangle", by_triangle)
        self._offsets = {}
        for name, offset in state.driven_offsets.items():
            parts = [upload(f"{name} {part}", each) for part, each in vars(offset).items()]
            self._offsets[name] = OffsetTables._make([*parts, splats_of])

    def _host_state(self) -> TrainState:
        """The copy that is edited: the latest state, which is read once between two steps."""
        if self._edited is None:
            self._edited = self.state
        return self._edited

    def _change(self, state: TrainState) -> None:
        self._edited = state
        self._is_changed = True

    def _upload_edited(self) -> None:
        if self._edited is not None and self._is_changed:
            self.state = self._edited
        self._edited = None

    def blend_weights(self, view: View) -> np.ndarray:
        host = CpuBackend(self._settings, self._frames, self._host_state())
        return host.blend_weights(view)

    def coefficients(self) -> dict[str, np.ndarray]:
        offsets = self._host_state().driven_offsets.items()
        return {name: offset.value for name, offset in offsets}

    def columns(self, names: Collection[str]) -> dict[str, np.ndarray]:
        arrays = arrays_of(self._host_state())
        return {name: arrays[name] for name in names}

    def assign(self, rows: np.ndarray, values: Mapping[str, np.ndarray | float]) -> None:
        state = self._host_state()
        assign_rows(state, rows, values)
        self._change(state)

    def keep(self, rows: np.ndarray) -> None:
        self._change(keep_rows(self._host_state(), rows))

    def append_halves(self, halving: Halving) -> None:
        self._change(with_halves(self._host_state(), halving))

    def step(self, batch: Batch) -> float | None:
        """Queue one step; returns the loss of the iteration before the last, if global."""
        self._upload_edited()
        loss = None
        if len(self._pending) == QUEUED_ITERATIONS:
            self._finish(0)
            loss = self._pending[0].loss
            self._readbacks.append(self._pending.popleft().readback)
        queued = _Queued(batch, self._readbacks.pop())
        self._pending.append(queued)
        self._enqueue(queued)
        return loss

    def render(self, view: View, options: RenderOptions) -> np.ndarray:
        self._finish_all()
        self._upload_edited()
        while True:
            with self.device.record() as work:
                rendering = self._render(work, view, options, averaged=True)
            if self._rasterizer.pairs_fit():
                shape = 3, view.camera.height, view.camera.width
                return self.device.read(rendering["image"], shape)

    def _finish_all(self) -> None:
        """Wait until all queued iterations are done."""
        for n in range(len(self._pending)):
            self._finish(n)

    def _finish(self, n: int) -> None:
        """Wait for the n-th queued iteration; repeat it and the later if its pairs did not fit."""
        pending = list(self._pending)
        queued = pending[n]
        while not queued.done:
            words = queued.readback.result()
            if words[OVERFLOWED]:
                for later in pending[n + 1 :]:
                    later.readback.result()
                self._rasterizer.make_room(int(words[NEEDED]))
                for again in pending[n:]:
                    self._enqueue(again)
            else:
                queued.done = True
                if queued.batch.selected is None:
                    queued.loss = float(words.view(np.float32)[COUNTS])

    def _enqueue(self, queued: _Queued) -> None:
        """Submit one iteration."""
        batch = queued.batch
        settings = self._settings
        whole = queued.batch.selected is None
        change = 255 * batch.options.background - 255 * np.array(settings.background, np.float32)
        upload_target(self.device, batch.target, settings.ssim_weight, batch.mask, change)
        opacity_weight = settings.unseen_opacity_weight / max(len(self), 1)
        optimizer.upload_step(
            self.device,
            batch.rates,
            adam_options(settings, batch.view.camera),
            (settings.scale_weight, settings.distance_weight, opacity_weight),
            statistics=batch.accumulate,
            triangles=self._triangles,
        )
        with self.device.record() as work:
            splats = self._splats
            camera = batch.view.camera
            rendering = self._render(work, batch.view, batch.options, batch.selected)
            v_image, loss = image_loss(
                work,
                camera.width,
                camera.height,
                whole=whole,
                **{name: rendering[name] for name in ("view", "image", "touched")},
            )
            screen = self._rasterizer.backward(
                work, rendering, splats, camera, v_image, self._gradients
            )
            given = {name: rendering[name] for name in ("view", "wanted")}
            given |= {"gradients": self._gradients, "splats": splats.rows}
            signals = self._embedding.signals
            optimizer.step_offsets(work, self._triangles, self._offsets, signals, **given)
            limited = bool(settings.scale_weight or settings.distance_weight)
            given |= {"face": splats.face, "screen": screen}
            optimizer.optimize(work, splats.count, splats.stride, limited, self._tables, **given)
            counts = rasterize.counts_buffer(self.device)
            queued.readback.copy_from(work, (counts, COUNTS), (loss, 1))
        queued.readback.start()

    def _render(
        self,
        work: Recording,
        view: View,
        options: RenderOptions,
        selected: np.ndarray | None = None,
        averaged: bool = False,
    ) -> rasterize.Tables:
        """Record a view of the splats, moved by the driven offsets; averaged: of the moving average
        of both.

        Only the tiles around the splats on the selected triangles, if any are given.
        """
        splats = self._splats
        moved = {name: tables.coefficients for name, tables in self._offsets.items()}
        if averaged:
            splats = replace(splats, rows=self._tables.average)
            moved = {name: tables.average for name, tables in self._offsets.items()}
        self._embedding.upload(self._frames.mesh(view.timestep), view.camera)
        given = rasterize.ViewOptions(
            view.camera,
            options.sh_degree,
            options.background,
            antialiased=self._settings.antialiased,
            focused=selected is not None,
            reach=LOSS_REACH_PX,
        )
        uniform = self._rasterizer.upload_view(splats, given)
        marked = None if selected is None else self.device.upload("selected", selected)
        focus = None if marked is None else rasterize.mark_focus(work, splats, uniform, marked)
        frames = self._embedding.compose(work, moved)
        return self._rasterizer.forward(work, splats, frames, given, uniform, focus)
