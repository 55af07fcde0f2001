"""Training backend on a GPU, by WebGPU kernels."""

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...avatar.offsets import OFFSETS
from ...avatar.strain import IndexLists
from ...capture.model import View
from ...raster.cpu.image_loss import LOSS_REACH_PX
from ...raster.cpu.layout import Parameters, rows_by_triangle
from ...raster.gpu import optimizer, rasterize
from ...raster.gpu.device import Device, Readback, Recording
from ...raster.gpu.frames import Embedding
from ...raster.gpu.layout import (
    COUNTS,
    LOG_SCALE,
    NEEDED,
    OPACITY_LOGIT,
    OVERFLOWED,
    ROTATION,
    SH,
    XYZ,
    list_words,
    splat_rows,
)
from ...raster.gpu.optimizer import OffsetTables, OptimizerTables, image_loss, upload_target
from ...raster.gpu.rows import Column, read_columns, take_rows, write_columns
from ..settings import TrainingSettings
from .adam import adam_options
from .backend import Batch, RenderOptions
from .cpu_backend import WITHOUT_COLOR
from .frames import FrameStore
from .state import OffsetState, TrainState, columns_of, state_of

QUEUED_ITERATIONS = 2
"""Iterations that the device may be behind; losses are returned as many iterations late."""
TABLES = {
    "parameters": "splats",
    "gradients": "gradients",
    "first": "first",
    "second": "second",
    "average": "average",
}
"""Arrays of a `TrainState` that are shaped as splats -> their table on the device."""
HISTORY = {"steps": np.int32, "screen_gradient": np.float32, "gradient_count": np.float32}
"""Columns of the table `history`."""
FIXED = ("face", "unbound", "unseen_share")
"""Columns that no iteration changes, which the host has as well."""


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

    Between steps, the host reads columns and names rows; all others stay where they are.
    """

    def __init__(
        self, device: Device, settings: TrainingSettings, frames: FrameStore, state: TrainState
    ) -> None:
        capture = frames.capture
        self._settings = settings
        self._frames = frames
        self.device = device
        self._triangles = len(capture.faces)
        distance_limits = settings.distance_limit * frames.units
        self._limits = np.column_stack([*frames.scale_limits(settings), distance_limits])
        self._rasterizer = rasterize.Rasterizer(device)
        self._embedding = Embedding(
            device, frames.surface.areas, capture.faces, frames.convention, frames.strain
        )
        self._pending: deque[_Queued] = deque()
        self._readbacks = [Readback(device, COUNTS + 1) for _ in range(QUEUED_ITERATIONS)]
        self._rasterizer.make_room(0)
        optimizer.compile_kernels(device)
        self.state = state

    def __len__(self) -> int:
        return self._splats.count

    @property
    def state(self) -> TrainState:
        arrays = self.columns(HISTORY)
        for part in TABLES:  # one by one, as there is room for
            arrays |= self.columns([f"{part}/{name}" for name in Parameters._fields])
        state = state_of(arrays | {name: array.copy() for name, array in self._fixed.items()})
        for name, each in self._offsets.items():
            shape = self._triangles, 3, 3
            parts = (each.coefficients, each.first, each.second, each.average)
            value, first, second, average = (self.device.read(part, shape) for part in parts)
            steps = self.device.read(each.steps, (self._triangles,), np.int32)
            state.driven_offsets[name] = OffsetState(value, first, second, average, steps)
        return state

    @state.setter
    def state(self, state: TrainState) -> None:
        self._finish_all()
        upload = self.device.upload
        columns = columns_of(state)
        tables = {
            name: upload(name, splat_rows(getattr(state, part))) for part, name in TABLES.items()
        }
        history = [columns[name].view(np.uint32) for name in HISTORY]
        tables["history"] = upload("history", np.stack(history, axis=1))
        upload("limits", self._limits.astype(np.float32))
        self._place(tables, {name: columns[name] for name in FIXED}, state.parameters.sh.shape[1])
        self._offsets = {}
        for name, offset in state.driven_offsets.items():
            parts = [upload(f"{name} {part}", each) for part, each in vars(offset).items()]
            self._offsets[name] = OffsetTables._make([*parts, self._splats_by_triangle(name)])

    def _place(
        self, tables: dict[str, Any], fixed: dict[str, np.ndarray], coefficients: int
    ) -> None:
        """Take tables on the device, and columns FIXED, as those of the splats from now on."""
        device = self.device
        self._fixed = fixed
        faces = device.upload("face", fixed["face"].astype(np.uint32))
        traits = np.stack([fixed["unbound"], fixed["unseen_share"]], axis=1, dtype=np.float32)
        count = len(fixed["face"])
        self._splats = rasterize.SplatTable(tables["splats"], faces, count, coefficients)
        self._gradients = tables["gradients"]
        self._tables = OptimizerTables(
            **{name: tables[name] for name in ("first", "second", "average", "history")},
            traits=device.upload("traits", traits),
            limits=device.buffer("limits", 0),
        )

    def _splats_by_triangle(self, name: str) -> Any:
        """Lists of the splats on each triangle; empty where this driven offset is not trained."""
        face = self._fixed["face"]
        is_trained = self._frames.is_trained(OFFSETS[name])
        starts, rows = rows_by_triangle(
            np.where(is_trained[face], face, self._triangles), self._triangles
        )
        lists = IndexLists(starts, rows[: starts[-1]])
        return self.device.upload(f"{name} splats by triangle", list_words(lists))

    def blend_weights(self, view: View) -> np.ndarray:
        self._finish_all()
        while True:
            uploaded = self._upload_view(view, WITHOUT_COLOR)
            with self.device.record() as work:
                rendering = self._record_view(work, uploaded)
                given = rendering, self._splats, view.camera
                weights = self._rasterizer.blend_weights(work, *given)
            if self._rasterizer.pairs_fit():
                return self.device.read(weights, (len(self),))

    def coefficients(self) -> dict[str, np.ndarray]:
        self._finish_all()
        shape = self._triangles, 3, 3
        tables = self._offsets.items()
        return {name: self.device.read(table.coefficients, shape) for name, table in tables}

    def columns(
        self, names: Collection[str], rows: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        self._finish_all()
        here = {name: self._fixed[name] for name in names if name in FIXED}
        there = {name: self._column(name) for name in names if name not in FIXED}
        if rows is not None:
            here = {name: column[rows] for name, column in here.items()}
        wanted = len(self) if rows is None else rows
        return here | (read_columns(self.device, there, wanted) if there else {})

    def assign(self, rows: np.ndarray, values: Mapping[str, np.ndarray | float]) -> None:
        self._finish_all()
        numbers = np.flatnonzero(rows) if rows.dtype == bool else rows
        if len(numbers):
            columns = [(self._column(name), value) for name, value in values.items()]
            write_columns(self.device, numbers, columns)

    def keep(self, rows: np.ndarray) -> None:
        self._finish_all()
        numbers = np.flatnonzero(rows) if rows.dtype == bool else rows
        tables = {
            name: (self.device.buffer(name, 0), self._splats.stride) for name in TABLES.values()
        }
        tables["history"] = self._tables.history, len(HISTORY)
        fixed = {name: column[numbers] for name, column in self._fixed.items()}
        self._place(take_rows(self.device, numbers, tables), fixed, self._splats.coefficients)
        if self._offsets:
            for name, offset in self._offsets.items():
                self._offsets[name] = offset._replace(splats_of=self._splats_by_triangle(name))

    def _column(self, name: str) -> Column:
        if name in HISTORY:
            place = list(HISTORY).index(name)
            return Column(self._tables.history, len(HISTORY), place, dtype=HISTORY[name])
        part, field = name.split("/")
        first, shape = {
            "xyz": (XYZ, (3,)),
            "rotation": (ROTATION, (4,)),
            "log_scale": (LOG_SCALE, (3,)),
            "opacity": (OPACITY_LOGIT, ()),
            "color": (SH, (3,)),
            "sh": (SH, (self._splats.coefficients, 3)),
        }[field]
        return Column(self.device.buffer(TABLES[part], 0), self._splats.stride, first, shape)

    def step(self, batch: Batch) -> float | None:
        """Queue one step; returns the loss of the iteration before the last, if global."""
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
        while True:
            uploaded = self._upload_view(view, options)
            with self.device.record() as work:
                rendering = self._record_view(work, uploaded, averaged=True)
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
        view = self._upload_view(batch.view, batch.options, batch.selected)
        width = view.camera.width
        height = view.camera.height
        # all that decides about the commands, beside buffers
        sizes = width, height, len(self), self._rasterizer.capacity
        key = whole, *sizes, *self._offsets, id(queued.readback)
        if not self.device.repeat(key):
            with self.device.record(key) as work:
                loss = self._record_step(work, view, whole)
                counts = rasterize.counts_buffer(self.device)
                queued.readback.copy_from(work, (counts, COUNTS), (loss, 1))
        queued.readback.start()

    def _record_step(self, work: Recording, view: rasterize.ViewOptions, whole: bool) -> Any:
        """Record an iteration; returns the table of its loss."""
        settings = self._settings
        splats = self._splats
        camera = view.camera
        rendering = self._record_view(work, view)
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
        return loss

    def _upload_view(
        self, view: View, options: RenderOptions, selected: np.ndarray | None = None
    ) -> rasterize.ViewOptions:
        """Send mesh, camera and selection of the next rendering: of the tiles around the splats on
        the selected triangles, if any are given."""
        self._embedding.upload(self._frames.mesh(view.timestep), view.camera)
        if selected is not None:
            self.device.upload("selected", selected)
        given = rasterize.ViewOptions(
            view.camera,
            options.sh_degree,
            options.background,
            antialiased=self._settings.antialiased,
            focused=selected is not None,
            reach=LOSS_REACH_PX,
        )
        self._rasterizer.upload_view(self._splats, given)
        return given

    def _record_view(
        self, work: Recording, view: rasterize.ViewOptions, averaged: bool = False
    ) -> rasterize.Tables:
        """Record the uploaded view of the splats, moved by the driven offsets; averaged: of the
        moving average of both."""
        splats = self._splats
        moved = {name: tables.coefficients for name, tables in self._offsets.items()}
        if averaged:
            splats = replace(splats, rows=self._tables.average)
            moved = {name: tables.average for name, tables in self._offsets.items()}
        buffer = self.device.buffer
        uniform = buffer("view", 0, "uniform")
        marked = buffer("selected", 0)
        focus = rasterize.mark_focus(work, splats, uniform, marked) if view.focused else None
        frames = self._embedding.compose(work, moved)
        return self._rasterizer.forward(work, splats, frames, view, uniform, focus)
