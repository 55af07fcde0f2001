"""How long each preset would take on this machine, from a few seconds of training on the capture itself."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import cycle, islice
from time import perf_counter

import numpy as np

from ..capture.images import read_view
from ..capture.loader import LoadedView
from ..capture.model import Capture, View
from ..effects.plan import plan_effects
from ..errors import StgaError
from ..selection import select_capture
from ..training.optimize.precompile import precompile_kernels
from ..training.optimize.trainer import Trainer
from ..training.schedule import image_scale, view_order
from ..training.settings import PRESETS, TrainingSettings, make_settings

SECONDS = 2.0
"""Seconds of training that a calibration takes, kernels and splats being ready."""
VIEWS = 8
"""Views that it goes through again and again."""
SETTLING = 3
"""First iterations, which only fetch memory, are not counted."""
MOST_ITERATIONS = 2000
"""A capture of a few pixels needs no more to be timed."""


@dataclass(frozen=True)
class PresetTiming:
    """A preset on this capture and machine: iterations, and the seconds of training that they will take."""

    preset: str
    purpose: str
    iterations: int
    seconds: float

    def as_json(self) -> dict[str, str | int | float]:
        return dict(vars(self))


def time_presets(
    capture: Capture, names: Iterable[str] = tuple(PRESETS), seconds: float = SECONDS, device: str = "cpu"
) -> list[PresetTiming]:
    """Time each preset for a few `seconds` on a device of `choose_device`.

    Raises StgaError where the capture has no training views.
    """
    if not capture.views.get("train"):
        raise StgaError(f"{capture.root}: has no training views, so there is nothing to train on")
    plans = []
    for name in names:
        iterations = PRESETS[name].iterations_for(len(capture.views["train"]))
        settings, _ = plan_effects(capture, make_settings(preset=name, iterations=iterations, effects={}), device)
        pace = seconds_per_iteration(capture, settings, seconds, device)
        plans.append(PresetTiming(name, PRESETS[name].purpose, iterations, iterations * pace))
    return plans


def seconds_per_iteration(
    capture: Capture, settings: TrainingSettings, seconds: float = SECONDS, device: str = "cpu"
) -> float:
    """Mean time of an iteration, from a run in small of which nothing is kept.

    Shares of the budget pass as in the whole run, so that coarse images, degrees of colour and local iterations count
    as much as they will. Reading images is not counted: the loader's thread does that meanwhile.
    """
    precompile_kernels()
    wanted = settings.strategy == "selective"
    trainer = Trainer(capture, settings, select_capture(capture, settings.selection) if wanted else {}, device=device)
    views = list(islice(view_order(capture.views["train"], settings.views_per_visit, settings.seed), VIEWS))
    sizes = {image_scale(settings, share) for share in (0.0, 1.0)}
    images = {size: cycle([_ready(view, size, settings.background) for view in views]) for size in sizes}
    times: list[float] = []
    while sum(times[SETTLING:]) < seconds and len(times) < MOST_ITERATIONS:
        share = min(1.0, sum(times[SETTLING:]) / seconds)
        view, image, mask = next(images[image_scale(settings, share)])
        begin = perf_counter()
        trainer.step(view, image, share, mask)
        times.append(perf_counter() - begin)
    return float(np.mean(times[SETTLING:]))


def _ready(view: View, size: float, background: tuple[float, ...]) -> LoadedView:
    """A view as the loader gives it: read-only arrays, for which the kernels are compiled."""
    red, green, blue = (round(255 * c) for c in background)
    small, image, mask = read_view(view, size, (red, green, blue))
    image.setflags(write=False)
    if mask is not None:
        mask.setflags(write=False)
    return small, image, mask
