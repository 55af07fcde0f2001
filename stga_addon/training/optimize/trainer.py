"""One training step: a view in, updated splats out."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from ...capture.model import Capture, View
from ...errors import StgaError
from ...render.device import adapter_name
from ..schedule import learning_rates, sh_degree
from ..settings import TrainingSettings
from .avatar_tracking import RefinedTracking
from .backend import Backend, Batch
from .cpu_backend import CpuBackend
from .frames import FrameStore
from .initial_splats import initial_splats, unseen_share
from .outlines import Outline, read_outlines
from .state import TrainState, new_state, with_offsets
from .strategies import (
    DensityControl,
    OutlineControl,
    PostStep,
    SideReset,
    StrayReset,
    make_strategy,
)
from .unseen_sides import UnseenSides, unseen_sides


class Trainer:
    """Trains a capture's splats step by step, on one backend, by one strategy.

    iteration      steps made so far
    visit          visits of frames so far, minus one: consecutive views of one timestep are one
                   visit
    initial_count  splats at the start of the run, which density control counts from
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

        strain_range (F, 2, 3): within which colors and positions follow strain; None: COLOR_RANGE.
        """
        self.capture, self.settings = capture, settings
        self.strategy = make_strategy(settings, selection)
        self.tracking = RefinedTracking(capture, settings.convention) if settings.tracking else None
        self.frames = FrameStore(
            capture, settings.convention, settings.follows_strain, self.tracking, strain_range
        )
        self.iteration, self.visit = 0, -1
        self.last_timestep: int | None = None
        self._background = np.array(settings.background, np.float32)
        if state is None:
            splats = initial_splats(capture, settings)
            state = new_state(splats, unseen_share(capture, settings.convention, splats))
            state = with_offsets(state, settings.driven_offsets, len(capture.faces))
        self._backend = make_backend(device, settings, self.frames, state)
        self.initial_count = len(self)

    def __len__(self) -> int:
        """How many splats there are."""
        return len(self._backend)

    @property
    def state(self) -> TrainState:
        """The splats and their optimizer. A GPU backend copies them, so do not read it in every
        iteration."""
        return self._backend.state

    @state.setter
    def state(self, state: TrainState) -> None:
        self._backend.state = state

    def restore(
        self,
        iteration: int,
        visit: int,
        last_timestep: int | None,
        initial_count: int,
    ) -> None:
        """Restore, beside the state given at construction, everything that the next step depends
        on."""
        self.iteration, self.visit = iteration, visit
        self.last_timestep, self.initial_count = last_timestep, initial_count

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
        if mesh is not None:
            self.frames.add(view.timestep, mesh)
        background = self._background
        if not settings.random_background:
            mask = None
        if mask is not None:
            background = np.random.default_rng([settings.seed, self.iteration]).random(
                3, np.float32
            )
        selected = self.strategy.triangles(self.iteration, self.visit, view.timestep, progress)
        loss = self._backend.step(
            Batch(
                view=view,
                target=target,
                mask=mask,
                background=background,
                sh_degree=sh_degree(settings, progress),
                selected=selected,
                rates=learning_rates(settings.rates, progress),
                accumulate=selected is None or self.strategy.region is not None,
            )
        )
        self.iteration += 1
        self._post_step(progress)
        return loss

    def render(self, view: View, progress: float = 1.0) -> np.ndarray:
        """The view with the splats' exponential moving average: a new (3, H, W) float32 image over
        the background."""
        return self._backend.render(view, self._background, sh_degree(self.settings, progress))

    @cached_property
    def _outlines(self) -> list[Outline]:
        return read_outlines(self.capture, self.settings.seed)

    @cached_property
    def _sides(self) -> UnseenSides:
        return unseen_sides(self.capture)

    @cached_property
    def _has_one_camera(self) -> bool:
        return len({view.camera_index for view in self.capture.views["train"]}) == 1

    def _post_step(self, progress: float) -> None:
        steps: tuple[PostStep, ...] = (
            StrayReset(self.settings, self.frames.units, self.strategy.region),
            DensityControl(self.settings, self.initial_count, self.strategy.region),
            OutlineControl(
                self.settings, self.frames, lambda: self._outlines, self.strategy.region
            ),
            SideReset(lambda: self._sides, self._has_one_camera and self.strategy.region is None),
        )
        due = [step for step in steps if step.is_due(self.iteration, progress)]
        if due:
            state = self.state
            for step in due:
                state = step.apply(state, self.iteration)
            self.state = state


def make_backend(
    device: str, settings: TrainingSettings, frames: FrameStore, state: TrainState
) -> Backend:
    """The backend of a device of `choose_device`. Raises StgaError if the device does not support
    the settings."""
    if device == "cpu":
        return CpuBackend(settings, frames, state)
    if settings.tracking:
        raise StgaError(
            f"--effect tracking=on: FLAME parameters are refined on the CPU only, not on {device}"
        )
    from ...raster.gpu.device import Device  # needs wgpu, which training on the CPU does without
    from ...raster.gpu.frames import SIGNALS
    from .gpu_backend import GpuBackend

    for name in state.driven_offsets:
        if name not in SIGNALS:
            raise StgaError(f"driven offset {name}: is trained on the CPU only, not on {device}")
    return GpuBackend(Device(adapter_name(device)), settings, frames, state)
