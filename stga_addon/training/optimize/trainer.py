"""The training loop's body: one view in, one step of the splats out."""

from dataclasses import replace

import numpy as np
import torch

from ...avatar.embedding import face_areas
from ...avatar.lattice import lattice_splats
from ...avatar.splats import Splats
from ...avatar.strain import STRAINS
from ...capture.model import Capture, View
from ..run.checkpoint import Checkpoint
from ..schedule import learning_rates, sh_degree, trains_globally
from ..settings import TrainingSettings
from .backend import Batch
from .density import control_density
from .device import make_backend
from .frames import FrameStore
from .hull_points import hull_points
from .state import TrainState, new_state
from .tracking import refinable_tracking, refinement_rate

SPLIT_SHARE = 0.02
"""Largest share of the splats that one round of density control splits."""


class Trainer:
    """A capture's splats in training: what is trained when. How an iteration is computed, its `Backend` knows.

    iteration  how many steps were made
    selection  timestep -> (F,) bool triangles that local iterations train; empty or missing means a global one
    """

    def __init__(
        self,
        capture: Capture,
        settings: TrainingSettings,
        selection: dict[int, np.ndarray],
        state: TrainState | None = None,
        device: str = "cpu",
    ) -> None:
        """device: one of `choose_device`."""
        self.capture, self.settings, self.selection = capture, settings, selection
        self.tracking = refinable_tracking(capture, settings.convention) if settings.tracking else None
        self.frames = FrameStore(capture, settings.convention, settings.strain_color, self.tracking)
        self._lengths = face_lengths(capture, settings.convention)
        state = new_state(initial_splats(capture, settings)) if state is None else state
        self._step = make_backend(device, settings, self._lengths, self.frames, state)
        self.iteration, self.visit = 0, -1
        self.initial_count = len(self)
        self._background = np.array(settings.background, np.float32)
        self.last_timestep: int | None = None

    def __len__(self) -> int:
        """How many splats there are."""
        return len(self._step)

    @property
    def state(self) -> TrainState:
        """The splats and their optimiser; a GPU copies them, so not for every iteration."""
        return self._step.state

    @state.setter
    def state(self, state: TrainState) -> None:
        self._step.state = state

    def continue_from(self, checkpoint: Checkpoint) -> None:
        """Take over everything that a step depends on."""
        self.state, self.iteration, self.visit = checkpoint.state, checkpoint.iteration, checkpoint.visit
        self.last_timestep, self.initial_count = checkpoint.last_timestep, checkpoint.initial_count
        if self.tracking is not None and checkpoint.tracking is not None:
            self.tracking.state = checkpoint.tracking

    def step(self, view: View, target: np.ndarray, progress: float, mask: np.ndarray | None = None) -> float | None:
        """Train one view.

        target (H, W, 3) uint8 over the settings' background; progress is the share of the budget spent; mask (H, W)
        uint8, with which the background may be exchanged.

        Returns the image loss of a global iteration; a local one sees only part of the image and returns None. A GPU
        tells the losses two iterations late.
        """
        settings = self.settings
        self.visit += view.timestep != self.last_timestep
        self.last_timestep = view.timestep
        whole = trains_globally(settings, self.iteration, self.visit, progress)
        background = self._background
        if not settings.random_background:
            mask = None
        if mask is not None:
            background = np.random.default_rng([settings.seed, self.iteration]).random(3, np.float32)
        selected = None if whole else self._selected(view.timestep)
        refine = refinement_rate(progress) if self.tracking is not None and selected is None else 0.0
        loss = self._step.train(
            Batch(
                view,
                target,
                mask,
                background,
                sh_degree(settings, progress),
                selected,
                learning_rates(settings.rates, progress),
                refine,
            )
        )
        self.iteration += 1
        self._maintain(progress)
        return loss

    def render(self, view: View, progress: float = 1.0) -> np.ndarray:
        """The view as the splats' running average shows it: a new (3, H, W) float32 image over the background."""
        return self._step.render(view, self._background, sh_degree(self.settings, progress))

    def _selected(self, timestep: int) -> np.ndarray | None:
        """(F,) bool: the frame's selected triangles; None where nothing is selected."""
        faces = self.selection.get(timestep)
        return faces if faces is not None and faces.any() else None

    def _maintain(self, progress: float) -> None:
        """Stray resets and density control, when their time has come."""
        settings = self.settings
        start, end = settings.density_span
        stray = _is_due(settings.stray_reset_interval, self.iteration)
        density = _is_due(settings.density_interval, self.iteration) and start <= progress < end
        if not stray and not density:
            return
        state = self.state
        if stray:
            reset_strays(state, settings.stray_limit * self._lengths, settings.stray_reset_share)
        if density:
            room = round(self.initial_count * (1 + settings.growth)) - len(state)
            rng = np.random.default_rng([settings.seed, self.iteration])
            state = control_density(state, room, SPLIT_SHARE, rng)
        self.state = state


def _is_due(every: int, iteration: int) -> bool:
    return every > 0 and iteration % every == 0


def initial_splats(capture: Capture, settings: TrainingSettings) -> Splats:
    """The lattice on the neutral mesh and, if asked for, hull seeds around it."""
    lattice = lattice_splats(
        capture.neutral, capture.faces, settings.lattice, settings.sh_degree, convention=settings.convention
    )
    if not settings.teeth:
        lattice = lattice.rows(~teeth_triangles(capture)[lattice.face])
    strains = STRAINS if settings.strain_color else 0
    lattice = replace(lattice, strain_color=np.zeros((len(lattice), strains, 3), np.float32))
    if not settings.hull_points:
        return lattice
    first = capture.views["train"][0].timestep
    views = [view for view in capture.views["train"] if view.timestep == first]
    seeds = hull_points(capture, views, settings.convention, settings.sh_degree)
    seeds = replace(seeds, strain_color=np.zeros((len(seeds), strains, 3), np.float32))
    return Splats(*(np.concatenate([getattr(lattice, n), getattr(seeds, n)]) for n in vars(lattice)))


def teeth_triangles(capture: Capture) -> np.ndarray:
    """(F,) bool: the triangles of the rows of teeth that FLAME's mesh is given; none in any other mesh."""
    masks = {} if capture.flame is None else capture.flame.model.masks
    return np.asarray(np.isin(capture.faces, masks.get("teeth", ())).all(axis=1))


def reset_strays(state: TrainState, limit: np.ndarray, to: float) -> int:
    """Put splats that left their triangle's neighbourhood back, to the share `to` of the limit; returns how many.

    limit (F,) in local units, from the triangle's origin. Loose splats may be anywhere. The moments of a position that
    was reset start anew. (STGA, training, which puts them onto the origin: to = 0.)
    """
    distance = state.parameters.xyz.norm(dim=1)
    allowed = torch.from_numpy(limit)[state.face.long()]
    strays = ~state.unbound & (distance > allowed)
    # Rounding must not leave them just beyond the limit, or they would be strays again.
    factor = (to * (1 - 1e-6) * allowed / distance)[strays, None]
    state.parameters.xyz[strays] = torch.where(factor > 0, factor * state.parameters.xyz[strays], 0)
    for tensor in (state.first.xyz, state.second.xyz):
        tensor[strays] = 0
    state.average.xyz[strays] = state.parameters.xyz[strays]
    return int(strays.sum())


def face_lengths(capture: Capture, convention: str) -> np.ndarray:
    """Length (F,) that limits are multiples of, in local units."""
    if convention == "gaussian_avatars":
        return np.ones(len(capture.faces), np.float32)
    return np.asarray(np.sqrt(2 * face_areas(capture.neutral, capture.faces)), np.float32)
