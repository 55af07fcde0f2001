"""Density control: splats are added where images call for detail, and faint ones pruned."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...flame.quaternions import to_matrices
from ...raster.cpu.layout import Parameters
from .backend import Backend
from .state import PRUNED_BY, opacity_of, parameters_and_average, prunable
from .step_hook import Schedule

HALVED = ("xyz", "rotation", "log_scale", "opacity")
"""Parameters of splats that halves have others of, or that these depend on."""
READ_COLUMNS = (
    "screen_gradient",
    "gradient_count",
    *PRUNED_BY,
    *(f"parameters/{name}" for name in HALVED),
)
WITHOUT_MOMENTUM = {f"first/{name}": 0.0 for name in Parameters._fields}


@dataclass(frozen=True)
class DensityControl:
    """Splits the splats with the largest mean screen gradient and prunes those of low opacity.

    The first five are those of `TrainingSettings`, whose defaults measured best at equal time
    (docs/method.md). A triangle with bound splats keeps one.

    interval       iterations between rounds, 0: never; default 100, as in 3D Gaussian Splatting
                   (Kerbl et al. 2023), 200 with the paper's settings
    span           fractions of the budget from and before which it works; default (0.1, 0.6)
    split_share    largest fraction of the splats that is split at a time; default 0.2, ours
    growth         most splats that are added, as a fraction of the whole lattice and the
                   visual-hull points; default 0.25, ours
    seed           of the halves' distances
    region_fraction   `split_share` where a region is trained, as in a refinement, which has few
                      rounds
    min_opacity    0…1, below which splats are pruned; ours, 0.005 in 3D Gaussian
                   Splatting. A half has twice as much at least
    narrowing      by which halves are narrower than their parent along its longest axis; 1.6 in 3D
                   Gaussian Splatting, along all
    distance       of a half's center from its parent's, in the parent's standard deviation along
                   that axis; ours
    jitter         standard deviation of that distance, as a fraction of it; ours
    """

    interval: int
    span: tuple[float, float]
    split_share: float
    growth: float
    seed: int
    region_fraction: float = 0.1
    min_opacity: float = 0.02
    narrowing: float = 1.6
    distance: float = 0.5
    jitter: float = 0.1

    def prepare(self) -> None:
        """Nothing is found out once."""

    def apply(self, backend: Backend, schedule: Schedule) -> None:
        start, end = self.span
        if not start <= schedule.progress < end:
            return
        columns = backend.columns(READ_COLUMNS)
        face = columns["face"]
        within = np.ones(len(face), bool) if schedule.region is None else schedule.region[face]
        split = self._split(columns, within, schedule)
        faint = opacity_of(columns["parameters/opacity"]) < self.min_opacity
        keep = ~prunable(columns, faint & within)
        keep[split] = False
        rng = np.random.default_rng([self.seed, schedule.iteration])
        distance = self.distance * (1 + self.jitter * rng.standard_normal((len(split), 1)))
        parents = {name: columns[f"parameters/{name}"][split] for name in HALVED}
        kept = np.flatnonzero(keep)
        rows = np.concatenate([kept, split, split])
        # by triangle, so that what is read together lies together in memory
        order = np.argsort(face[rows], kind="stable")
        backend.keep(rows[order])
        # Adam's second moment and step count are the parent's, without which the first steps would
        # all be as long as the rate
        values = parameters_and_average(self._halves(parents, distance))
        halves = np.argsort(order)[len(kept) :]
        backend.assign(halves, {**values, **WITHOUT_MOMENTUM})
        every = np.ones(len(backend), bool)
        backend.assign(every, {"screen_gradient": 0.0, "gradient_count": 0.0})

    def score(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) mean screen gradient of each splat: how much detail is missing there."""
        gradient = columns["screen_gradient"] / np.maximum(columns["gradient_count"], 1)
        return np.asarray(gradient)

    def _split(
        self, columns: Mapping[str, np.ndarray], within: np.ndarray, schedule: Schedule
    ) -> np.ndarray:
        """Rows of the highest scores among those within (N,) bool, the highest first."""
        score = np.where(within, self.score(columns), 0)
        fraction = self.split_share if schedule.region is None else self.region_fraction
        room = round(schedule.initial_count * (1 + self.growth)) - len(score)
        count = max(0, min(room, int(fraction * within.sum())))
        rows = np.argsort(-score, kind="stable")[:count]
        return np.asarray(rows[score[rows] > 0])

    def _halves(
        self, parents: Mapping[str, np.ndarray], distance: np.ndarray
    ) -> dict[str, np.ndarray]:
        """HALVED of both halves of M splats: first all on one side, then all on the other, within
        the parent's Gaussian in local units; distance (M, 1): `self.distance` of each."""
        n = np.arange(len(distance))
        log_scale = parents["log_scale"].copy()
        longest = np.argmax(log_scale, axis=1)
        length = np.exp(log_scale[n, longest])[:, None]
        away = to_matrices(parents["rotation"])[n, :, longest] * length * distance
        log_scale[n, longest] -= np.log(self.narrowing)
        # of two Gaussians beside each other, so much narrower, that cover as much as one
        alike = self.narrowing / 2 * opacity_of(parents["opacity"])
        opacity = np.maximum(alike, 2 * self.min_opacity)
        either = {
            **parents,
            "log_scale": log_scale,
            "opacity": np.log(opacity / (1 - opacity)).astype(np.float32),
        }
        sides = [
            {**either, "xyz": (parents["xyz"] + side * away).astype(np.float32)} for side in (-1, 1)
        ]
        return {name: np.concatenate([side[name] for side in sides]) for name in HALVED}
