"""Training strategies: which triangles an iteration trains, and what happens after a step."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from ..settings import CONTINUATIONS, TrainingSettings
from .density import MAX_SPLIT_SHARE, control_density, reset_strays
from .frames import FrameStore
from .outlines import Outline, prune_outside
from .state import TrainState
from .unseen_sides import UnseenSides

EXTEND_LOCAL_SHARE = 0.5
"""Share of an extension's budget that trains what the new takes need, before all splats are
trained."""
MAX_REGION_SPLIT_SHARE = 0.1
"""Largest share of a region's splats that one round of density control splits: a refinement has few
rounds."""

OUTLINE_INTERVAL, SIDE_INTERVAL = 200, 100
"""Iterations between turns of `OutlineControl` and `SideReset`."""


class Strategy(Protocol):
    """Decides which triangles each iteration trains.

    region  (F,) bool: the only triangles whose splats the run may change; None for all
    """

    @property
    def region(self) -> np.ndarray | None: ...

    def triangles(
        self, iteration: int, visit: int, timestep: int, progress: float
    ) -> np.ndarray | None:
        """(F,) bool triangles whose splats are trained; None trains all splats.

        iteration, visit  count iterations and visits of frames (consecutive views of one timestep)
                          from 0
        progress          share of the budget spent
        """


class GlobalStrategy:
    """Every iteration trains all splats."""

    region = None

    def triangles(self, iteration: int, visit: int, timestep: int, progress: float) -> None:
        return None


@dataclass
class SelectiveStrategy:
    """Alternates local iterations, which train a frame's selected triangles, with global ones
    (STGA, training).

    selection  timestep -> (F,) bool triangles; a frame that selects none is trained globally
    """

    settings: TrainingSettings
    selection: Mapping[int, np.ndarray]
    region = None

    def triangles(
        self, iteration: int, visit: int, timestep: int, progress: float
    ) -> np.ndarray | None:
        settings, selected = self.settings, self.selection.get(timestep)
        count = iteration if settings.global_unit == "iteration" else visit
        is_global = count % (settings.global_interval + 1) == settings.global_interval
        if progress < settings.warm_up_share or is_global or selected is None or not selected.any():
            return None
        return selected


@dataclass
class RefineStrategy:
    """Every iteration trains the same region."""

    region: np.ndarray

    def triangles(self, iteration: int, visit: int, timestep: int, progress: float) -> np.ndarray:
        return self.region


@dataclass
class ExtendStrategy:
    """Trains what new takes need, in views of all takes, and then all splats.

    Not in turn: where some splats are frozen in the new views only, the others make up for them
    there, and drift.

    region  (F,) bool: what moves in the new takes, or looks different there
    """

    region: np.ndarray

    def triangles(
        self, iteration: int, visit: int, timestep: int, progress: float
    ) -> np.ndarray | None:
        return self.region if progress < EXTEND_LOCAL_SHARE and self.region.any() else None


def make_strategy(settings: TrainingSettings, selection: Mapping[int, np.ndarray]) -> Strategy:
    """The strategy that the settings name; "gaussian-avatars" differs from "global" in its settings
    only.

    selection: timestep -> (F,) bool; "refine" and "extend" train the union.
    """
    if settings.strategy in CONTINUATIONS:
        union = np.any(list(selection.values()), axis=0)
        return RefineStrategy(union) if settings.strategy == "refine" else ExtendStrategy(union)
    return (
        SelectiveStrategy(settings, selection)
        if settings.strategy == "selective"
        else GlobalStrategy()
    )


class PostStep(Protocol):
    """Changes the splats at intervals, after an optimizer step."""

    def is_due(self, iteration: int, progress: float) -> bool:
        """Whether to `apply` after so many iterations, at this share of the budget."""

    def apply(self, state: TrainState, iteration: int) -> TrainState:
        """The changed state, which may share arrays with `state` or change them in place."""


@dataclass(frozen=True)
class StrayReset:
    """Moves splats back that left their triangle's neighborhood; `unit` (F,) is what the limit is a
    multiple of.

    region  (F,) bool: only splats on these triangles are moved; None for all
    """

    settings: TrainingSettings
    unit: np.ndarray
    region: np.ndarray | None = None

    def is_due(self, iteration: int, progress: float) -> bool:
        return _at_interval(iteration, self.settings.stray_reset_interval)

    def apply(self, state: TrainState, iteration: int) -> TrainState:
        limit = self.settings.stray_limit * self.unit
        if self.region is not None:
            limit = np.where(self.region, limit, np.inf).astype(limit.dtype)
        reset_strays(state, limit, self.settings.stray_reset_share)
        return state


@dataclass(frozen=True)
class DensityControl:
    """Splits and prunes splats; the count may grow to (1 + `settings.growth`) · `initial_count`.

    region  (F,) bool: only splats on these triangles are split and pruned; None for all
    """

    settings: TrainingSettings
    initial_count: int
    region: np.ndarray | None = None

    def is_due(self, iteration: int, progress: float) -> bool:
        start, end = self.settings.density_span
        return _at_interval(iteration, self.settings.density_interval) and start <= progress < end

    def apply(self, state: TrainState, iteration: int) -> TrainState:
        budget = round(self.initial_count * (1 + self.settings.growth)) - len(state)
        share = MAX_SPLIT_SHARE if self.region is None else MAX_REGION_SPLIT_SHARE
        return control_density(
            state,
            budget,
            np.random.default_rng([self.settings.seed, iteration]),
            share,
            self.region,
        )


@dataclass(frozen=True)
class OutlineControl:
    """Prunes splats outside of the outlines of the masks, where alpha is learned from them.

    region  (F,) bool: only splats on these triangles are pruned; None for all
    """

    settings: TrainingSettings
    frames: FrameStore
    outlines: Callable[[], Sequence[Outline]]
    region: np.ndarray | None = None

    def is_due(self, iteration: int, progress: float) -> bool:
        return self.settings.random_background and _at_interval(iteration, OUTLINE_INTERVAL)

    def apply(self, state: TrainState, iteration: int) -> TrainState:
        coefficients = {name: offset.value for name, offset in state.driven_offsets.items()}
        frames = partial(self.frames.moved, coefficients=coefficients)
        return prune_outside(state, frames, self.outlines(), self.region)


@dataclass(frozen=True)
class SideReset:
    """Gives splats on sides that the only camera never shows their color back."""

    sides: Callable[[], UnseenSides]
    applies: bool

    def is_due(self, iteration: int, progress: float) -> bool:
        return self.applies and _at_interval(iteration, SIDE_INTERVAL)

    def apply(self, state: TrainState, iteration: int) -> TrainState:
        return self.sides().restore(state)


def _at_interval(iteration: int, interval: int) -> bool:
    return interval > 0 and iteration % interval == 0
