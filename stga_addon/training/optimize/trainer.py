"""One training step: a view in, updated splats out."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...avatar.file import UNSEEN_REGION, Avatar
from ...avatar.lattice import splats_per_triangle
from ...avatar.splats import joined
from ...capture.model import Capture, View
from ...schema import to_json
from ..schedule import learning_rates, sh_degree
from ..settings import TrainingSettings
from .avatar_tracking import RefinedTracking
from .backend import Batch, RenderOptions
from .density import DensityControl
from .floaters import FloaterPruning
from .frames import FrameStore
from .hidden_layers import above_unseen_hair, hidden_splats, splats_behind
from .initial_splats import initial_splats, unseen_fraction
from .make_backend import make_backend
from .outliers import OutlierReset
from .outlines import OutlinePruning
from .state import TrainState, new_state, with_offsets
from .step_hook import Schedule, StepHook, is_due
from .surface_prior import SurfacePrior
from .unseen_sides import plausible_off_axis


class Start(NamedTuple):
    """What a training begins with.

    state         None: new splats
    strain_range  (F, 2, 6): within which deformation is followed; None: TRAINED_RANGE
    """

    state: TrainState | None = None
    strain_range: np.ndarray | None = None


NEW = Start()


class Strategy:
    """Decides which triangles each iteration trains, by `TrainingSettings.strategy`.

    region  (F,) bool: the only triangles whose splats a refinement may change; None for all

    "selective" alternates local iterations, which train a frame's selected triangles, with global
    ones (STGA, training). "refine" trains its region throughout, all others all splats.
    """

    def __init__(self, settings: TrainingSettings, selection: Mapping[int, np.ndarray]) -> None:
        """selection: timestep -> (F,) bool triangles; a refinement trains the union."""
        self._settings = settings
        self._selection = selection
        refines = settings.strategy == "refine"
        self.region = np.any(list(selection.values()), axis=0) if refines else None

    def triangles(
        self, iteration: int, visit: int, timestep: int, progress: float
    ) -> np.ndarray | None:
        """(F,) bool triangles whose splats are trained; None trains all splats.

        iteration, visit  count iterations and visits of frames (consecutive views of one timestep)
                          from 0
        progress          fraction of the budget spent
        """
        settings = self._settings
        if self.region is not None:
            return self.region
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
    initial_count  splats of the whole lattice and visual-hull points, which density control counts
                   from
    hooks          by name, what may edit the splats after a step, in this order
    """

    def __init__(
        self,
        capture: Capture,
        settings: TrainingSettings,
        selection: Mapping[int, np.ndarray],
        start: Start = NEW,
        device: str = "cpu",
    ) -> None:
        """selection: timestep -> (F,) bool triangles, for the selective strategy; device: one of
        `choose_device`."""
        self.capture = capture
        self.settings = settings
        self.strategy = Strategy(settings, selection)
        self.tracking = RefinedTracking(capture, settings.convention) if settings.tracking else None
        moved = {} if self.tracking is None else {"moved_mesh": self.tracking.mesh}
        limits = start.strain_range
        self.frames = FrameStore(
            capture, settings.convention, settings.follows_strain, limits=limits, **moved
        )
        self.iteration = 0
        self.visit = -1
        self.last_timestep: int | None = None
        self._progress: float | None = None
        self._background = np.array(settings.background, np.float32)
        if start.state is None:
            state, self.initial_count = _placed_splats(self.frames, settings)
        else:
            state = start.state
            self.initial_count = len(state)
        self._backend = make_backend(device, settings, self.frames, state)
        limits = self.frames.outlier_limits(settings)
        interval = settings.stray_reset_interval
        self.hooks: dict[str, StepHook] = {
            "outliers": OutlierReset(interval, limits, settings.stray_reset_share),
            "density": density_control(settings),
        }
        if settings.random_background:  # alpha is learned from masks
            self.hooks["outlines"] = OutlinePruning(capture, settings.seed, self.frames.moved)
        self.hooks["floaters"] = FloaterPruning(capture)
        if self.strategy.region is None:
            self.hooks["unseen sides"] = SurfacePrior(self.frames)

    def __len__(self) -> int:
        """How many splats there are."""
        return len(self._backend)

    @property
    def state(self) -> TrainState:
        """The training state. A GPU backend copies it, so do not read it in every iteration."""
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
        progress  fraction of the budget spent
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
            RenderOptions(background, sh_degree(settings, progress)),
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
        options = RenderOptions(self._background, sh_degree(self.settings, progress))
        return self._backend.render(view, options)

    def avatar(self, principal_point: str, strain_range: np.ndarray | None) -> Avatar:
        """The avatar of now, made of moving averages; the arguments become its fields."""
        state = self.state
        settings = self.settings
        capture = self.capture
        splats = state.splats(averaged=True)
        along = self.frames.surface.filmed_along if splats.sh_degree == 0 else None
        if along is not None:
            splats = plausible_off_axis(splats, along, self.frames.sides, self.frames.neutral)
        return Avatar(
            splats=splats,
            convention=settings.convention,
            neutral=capture.neutral.astype(np.float32),
            faces=capture.faces,
            settings=to_json(settings),
            regions={**capture.regions, UNSEEN_REGION: self.frames.surface.hidden},
            background=settings.background,
            antialiased=settings.antialiased,
            principal_point=principal_point,
            strain_range=strain_range,
            driven_offsets={n: each.average.copy() for n, each in state.driven_offsets.items()},
            filmed_along=along,
        ).with_limited_offsets

    def prepare_hooks(self) -> None:
        """Find out now what the first calls of the hooks would find out once."""
        for hook in self.hooks.values():
            hook.prepare()

    def _post_step(self, progress: float) -> None:
        """Call the hooks that are due after an optimizer step."""
        before = self._progress
        if before is None:  # begun or resumed: as of steps that all take the same fraction
            before = progress * (1 - 1 / max(1, self.iteration - 1))
        self._progress = progress
        region = self.strategy.region
        schedule = Schedule(self.iteration, progress, self.initial_count, region, before)
        for hook in self.hooks.values():
            if is_due(hook, schedule):
                hook.apply(self._backend, schedule)


def density_control(settings: TrainingSettings) -> DensityControl:
    return DensityControl(
        settings.density_interval,
        settings.density_span,
        settings.split_share,
        settings.growth,
        settings.seed,
    )


def _placed_splats(frames: FrameStore, settings: TrainingSettings) -> tuple[TrainState, int]:
    """The splats that a training begins with, and how many there would be on the whole lattice."""
    capture = frames.capture
    triangles = len(capture.faces)
    splats = initial_splats(capture, settings, frames.surface.has_long_hair)
    replaced = ~splats.unbound & frames.surface.closed[splats.face]
    replaced |= above_unseen_hair(frames, splats)
    layer = hidden_splats(frames, settings)
    color = np.zeros((triangles, 3), np.float32)
    bound = ~splats.unbound
    color[splats.face[bound]] = splats.sh[bound, 0]
    layer.sh[:, 0] = color[layer.face]
    splats = splats.rows(~replaced)
    orders = settings.lattice_order, settings.first_lattice_order
    whole, first = (splats_per_triangle(order(triangles)) for order in orders)
    lattice = int((~splats.unbound).sum())
    splats = joined([splats, layer, splats_behind(frames, settings.sh_degree)])
    splats = splats.rows(np.argsort(splats.face, kind="stable"))
    state = new_state(splats, unseen_fraction(capture, settings.convention, splats))
    state = with_offsets(state, settings.driven_offsets, triangles)
    return state, len(state) + lattice * whole // first - lattice
