"""One training step: a view in, updated splats out."""

from collections.abc import Mapping
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from ...avatar.file import Avatar
from ...avatar.lattice import splats_per_triangle
from ...avatar.offsets import OFFSETS
from ...capture.model import Capture, View, cameras_at_once
from ...errors import StgaError
from ...render.device import adapter_name
from ...schema import to_json
from ..schedule import learning_rates, sh_degree
from ..settings import CONTINUATIONS, TrainingSettings
from . import post_step
from .avatar_tracking import RefinedTracking
from .cpu_backend import CpuBackend
from .frames import FrameStore
from .initial_splats import initial_splats, unseen_share
from .state import Batch, TrainState, new_state, with_offsets

if TYPE_CHECKING:  # needs wgpu, which training on the CPU does without
    from .gpu_backend import GpuBackend

MAX_REGION_SPLIT_SHARE = 0.1
"""Largest share of a region's splats that is split at a time: a refinement has few rounds."""
OUTLINE_INTERVAL = 200
SIDE_INTERVAL = 100
"""Iterations between turns of pruning outside of the masks, and of coloring unseen sides."""
EXTEND_LOCAL_SHARE = 0.5
"""Of an extension's budget, in which what the new takes need is trained, before all splats."""


class Strategy:
    """Decides which triangles each iteration trains, as `TrainingSettings.strategy` says.

    region          (F,) bool: the only triangles whose splats the run may change; None for all
    refined_region  the same of a refinement; None for any other run

    "selective" alternates local iterations, which train a frame's selected triangles, with global
    ones (STGA, training). "refine" trains the same region throughout, "extend" first what new takes
    need, in views of all takes, and then all splats. Not in turn: where some splats are frozen in
    the new views only, the others make up for them there, and drift.
    """

    def __init__(self, settings: TrainingSettings, selection: Mapping[int, np.ndarray]) -> None:
        """selection: timestep -> (F,) bool triangles; continuations train the union."""
        self._settings = settings
        self._selection = selection
        continues = settings.strategy in CONTINUATIONS
        self.region = np.any(list(selection.values()), axis=0) if continues else None
        self.refined_region = self.region if settings.strategy == "refine" else None

    def triangles(
        self, iteration: int, visit: int, timestep: int, progress: float
    ) -> np.ndarray | None:
        """(F,) bool triangles whose splats are trained; None trains all splats.

        iteration, visit  count iterations and visits of frames (consecutive views of one timestep)
                          from 0
        progress          share of the budget spent
        """
        settings = self._settings
        region = self.region
        if region is not None:
            is_local = progress < EXTEND_LOCAL_SHARE and region.any()
            return region if settings.strategy == "refine" or is_local else None
        selected = self._selection.get(timestep)
        count = iteration if settings.global_unit == "iteration" else visit
        is_global = count % (settings.global_interval + 1) == settings.global_interval
        if settings.strategy != "selective" or progress < settings.warm_up_share or is_global:
            return None
        return selected if selected is not None and selected.any() else None


class Trainer:
    """Trains a capture's splats step by step, on one backend, by one strategy.

    iteration      steps made so far
    visit          visits of frames so far, minus one: consecutive views of one timestep are one
                   visit
    initial_count  splats of the whole lattice and hull points, which density control counts from
    """

    def __init__(
        self,
        capture: Capture,
        settings: TrainingSettings,
        selection: Mapping[int, np.ndarray],
        state: TrainState | None = None,
        device: str = "cpu",
        strain_range: np.ndarray | None = None,
    ) -> None:
        """selection: timestep -> (F,) bool triangles, for the selective strategy; device: one of
        `choose_device`.

        strain_range (F, 2, 6): within which deformation is followed; None: TRAINED_RANGE.
        """
        self.capture = capture
        self.settings = settings
        self.strategy = Strategy(settings, selection)
        self.tracking = RefinedTracking(capture, settings.convention) if settings.tracking else None
        moved = {} if self.tracking is None else {"moved_mesh": self.tracking.mesh}
        self.frames = FrameStore(
            capture, settings.convention, settings.follows_strain, limits=strain_range, **moved
        )
        self.iteration = 0
        self.visit = -1
        self.last_timestep: int | None = None
        self._background = np.array(settings.background, np.float32)
        begins = state is None
        if state is None:
            splats = initial_splats(capture, settings)
            state = new_state(splats, unseen_share(capture, settings.convention, splats))
            state = with_offsets(state, settings.driven_offsets, len(capture.faces))
        self._backend = make_backend(device, settings, self.frames, state)
        self._has_one_camera = cameras_at_once(capture.views["train"]) == 1
        self.initial_count = len(self)
        if begins:
            orders = settings.lattice_order, settings.first_lattice_order
            whole, first = (splats_per_triangle(order(len(capture.faces))) for order in orders)
            bound = int((~self.state.unbound).sum())
            self.initial_count += bound * whole // first - bound

    def __len__(self) -> int:
        """How many splats there are."""
        return len(self._backend)

    @property
    def state(self) -> TrainState:
        """A GPU backend copies it, so do not read it in every iteration."""
        return self._backend.state

    @state.setter
    def state(self, state: TrainState) -> None:
        self._backend.state = state

    def step(
        self,
        view: View,
        target: np.ndarray,
        progress: float,
        mask: np.ndarray | None = None,
        mesh: np.ndarray | None = None,
    ) -> float | None:
        """Train one view.

        target    (H, W, 3) uint8 over the settings' background
        progress  share of the budget spent
        mask      (H, W) uint8 coverage, with which the background may be randomized
        mesh      (V, 3) the capture's mesh of the view's timestep, if it has been read already

        Returns the image loss of a global iteration; None for a local one, which renders only part
        of the image. A GPU backend returns losses two iterations late.
        """
        settings = self.settings
        self.visit += view.timestep != self.last_timestep
        self.last_timestep = view.timestep
        self.frames.mesh(view.timestep, mesh)
        background = self._background
        mask = mask if settings.random_background else None
        if mask is not None:
            rng = np.random.default_rng([settings.seed, self.iteration])
            background = rng.random(3, np.float32)
        selected = self.strategy.triangles(self.iteration, self.visit, view.timestep, progress)
        batch = Batch(
            view,
            target,
            mask,
            background,
            sh_degree(settings, progress),
            selected,
            learning_rates(settings.rates, progress),
            accumulate=selected is None or self.strategy.region is not None,
        )
        loss = self._backend.step(batch)
        self.iteration += 1
        self._post_step(progress)
        return loss

    def render(self, view: View, progress: float = 1.0) -> np.ndarray:
        """With the splats' moving average: a new (3, H, W) float32 image over the background."""
        return self._backend.render(view, self._background, sh_degree(self.settings, progress))

    def avatar(self, principal_point: str, strain_range: np.ndarray | None) -> Avatar:
        """The avatar of now, made of moving averages; the arguments become its fields."""
        state = self.state
        settings = self.settings
        capture = self.capture
        return Avatar(
            splats=state.splats(averaged=True),
            convention=settings.convention,
            neutral=capture.neutral.astype(np.float32),
            faces=capture.faces,
            settings=to_json(settings),
            regions=dict(capture.regions),
            background=settings.background,
            antialiased=settings.antialiased,
            principal_point=principal_point,
            strain_range=strain_range,
            driven_offsets={n: each.average.copy() for n, each in state.driven_offsets.items()},
        ).without_invisible_offsets

    def prepare_turns(self) -> None:
        """Find out now what the first turns of changes to the splats would find out once."""
        if self._prunes_outside:
            self._outlines  # noqa: B018
        if self._colors_unseen_sides:
            self._sides  # noqa: B018

    @property
    def _prunes_outside(self) -> bool:
        """Where alpha is learned from masks."""
        return self.settings.random_background

    @property
    def _colors_unseen_sides(self) -> bool:
        return self._has_one_camera and self.strategy.region is None

    @cached_property
    def _outlines(self) -> list[post_step.Outline]:
        return post_step.read_outlines(self.capture, self.settings.seed)

    @cached_property
    def _sides(self) -> post_step.UnseenSides:
        return post_step.unseen_sides(self.capture)

    def _post_step(self, progress: float) -> None:
        """Change the splats after an optimizer step, where it is the turn of one of the changes."""
        settings = self.settings
        region = self.strategy.region
        count = self.iteration

        def is_turn(interval: int) -> bool:
            return interval > 0 and count % interval == 0

        moves_strays = is_turn(settings.stray_reset_interval)
        start, end = settings.density_span
        splits = start <= progress < end and is_turn(settings.density_interval)
        prunes = self._prunes_outside and is_turn(OUTLINE_INTERVAL)
        colors = self._colors_unseen_sides and is_turn(SIDE_INTERVAL)
        if not (moves_strays or splits or prunes or colors):
            return
        state = self.state
        if moves_strays:
            limit = settings.stray_limit * self.frames.units
            if region is not None:
                limit = np.where(region, limit, np.inf).astype(limit.dtype)
            post_step.reset_strays(state, limit, settings.stray_reset_share)
        if splits:
            budget = round(self.initial_count * (1 + settings.growth)) - len(state)
            share = settings.split_share if region is None else MAX_REGION_SPLIT_SHARE
            rng = np.random.default_rng([settings.seed, count])
            state = post_step.control_density(state, budget, rng, share, region)
        if prunes:
            coefficients = {name: offset.value for name, offset in state.driven_offsets.items()}
            frames = partial(self.frames.moved, coefficients=coefficients)
            state = post_step.prune_outside(state, frames, self._outlines, region)
        if colors:
            state = self._sides.restore(state)
        self.state = state


def make_backend(
    device: str, settings: TrainingSettings, frames: FrameStore, state: TrainState
) -> "CpuBackend | GpuBackend":
    """Of a device of `choose_device`. Raises StgaError if it does not support the settings."""
    if device == "cpu":
        return CpuBackend(settings, frames, state)
    if settings.tracking:
        text = f"FLAME parameters are refined on the CPU only, not on {device}"
        raise StgaError(f"--effect tracking=on: {text}")
    from ...raster.gpu.device import Device
    from ...raster.gpu.frames import SIGNALS
    from .gpu_backend import GpuBackend

    for name in state.driven_offsets:
        if OFFSETS[name].signal not in SIGNALS:
            raise StgaError(f"driven offset {name}: is trained on the CPU only, not on {device}")
    return GpuBackend(Device(adapter_name(device)), settings, frames, state)
