"""Schedules over the training budget: views, harmonics, learning rates, image scale."""

from collections.abc import Iterator, Sequence
from itertools import count

import numpy as np

from ..capture.model import View, views_by_timestep
from .settings import Rates, TrainingSettings

COARSE_SCALE = 0.5
"""Size of the images during `TrainingSettings.coarse_share`, as a fraction of the size trained at
afterwards."""
MIN_COARSE_SIDE_PX = 200
"""Shorter side below which images are not shrunk: splats take the time there, and half of so few
pixels show too little."""


def view_order(views: Sequence[View], per_visit: int, seed: int, start: int = 0) -> Iterator[View]:
    """Endless random order of views, without the first `start`.

    Views of a timestep are visited in groups of `per_visit` (0: all of them, the paper's batches;
    1: fully shuffled), and the groups in random order. Epoch e depends on (seed, e) alone, so a
    resumed run continues the same order.
    """
    frames = views_by_timestep(views)
    skip = start % len(views)
    for epoch in count(start // len(views)):
        rng = np.random.default_rng([seed, epoch])
        visits = []
        for frame in frames.values():
            shuffled = [frame[n] for n in rng.permutation(len(frame))]
            size = per_visit or len(shuffled)
            visits += [shuffled[n : n + size] for n in range(0, len(shuffled), size)]
        yield from [view for n in rng.permutation(len(visits)) for view in visits[n]][skip:]
        skip = 0


def take_order(
    takes: Sequence[Sequence[View]], per_visit: int, seed: int, start: int = 0
) -> Iterator[View]:
    """Endless order of the views of several takes, which take turns however many views they have;
    each in a `view_order` of its own."""
    turns = len(takes)
    orders = [
        view_order(views, per_visit, seed + turn, (start + turns - 1 - turn) // turns)
        for turn, views in enumerate(takes)
    ]
    for position in count(start):
        yield next(orders[position % turns])


def sh_degree(settings: TrainingSettings, progress: float) -> int:
    """Degree of spherical harmonics in use at a fraction of the budget."""
    return min(settings.sh_degree, sum(progress >= step for step in settings.sh_steps))


def learning_rates(rates: Rates, progress: float) -> dict[str, float]:
    """Exponential decay from the initial rates to their ends."""
    initial = {
        name: rate for name, rate in vars(rates).items() if name not in ("position_end", "end")
    }
    ends = {name: rates.position_end if name == "xyz" else rates.end for name in initial}
    return {name: rate * ends[name] ** min(1.0, progress) for name, rate in initial.items()}


def image_scales(settings: TrainingSettings, views: Sequence[View]) -> tuple[float, float]:
    """Image scales during `coarse_share` of the budget and afterwards, as fractions of the captured
    size."""
    least = min(min(view.camera.width, view.camera.height) for view in views)
    is_large = COARSE_SCALE * settings.scale * least >= MIN_COARSE_SIDE_PX
    return settings.scale * (COARSE_SCALE if is_large else 1.0), settings.scale
