"""How long each preset would train on this machine, measured on the capture itself."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import cycle, islice
from time import perf_counter

import numpy as np

from ..capture.loader import LoadedView, ViewLoader
from ..capture.model import Capture, evenly_spread, views_by_timestep
from ..capture.selection import select_capture
from ..errors import StgaError
from .effects.plan import plan_effects
from .optimize.avatar_tracking import TrainedAvatar, track_by_avatar, tracked_timesteps
from .optimize.image_preparation import image_preparation
from .optimize.precompile import precompile_kernels
from .optimize.trainer import Trainer, density_control
from .schedule import image_scales, view_order
from .settings import PRESETS, TrainingSettings, make_settings

CALIBRATION_S = 2.0
"""Training time that is measured per preset."""
CALIBRATION_VIEWS = 8
"""Views that the calibration trains, in turn."""
WARM_UP_ITERATIONS = 3
"""First iterations that are not measured: they allocate memory."""
TRACKED_TIMESTEPS = 3
"""Number of timesteps with which the time of tracking by the avatar is measured."""
MAX_ITERATIONS = 2000
"""Limit for captures of a few pixels."""


@dataclass(frozen=True)
class PresetTiming:
    """A preset's iterations for a capture, and the seconds that they are expected to take."""

    preset: str
    purpose: str
    iterations: int
    seconds: float


def time_presets(
    capture: Capture, seconds: float = CALIBRATION_S, device: str = "cpu"
) -> Iterator[PresetTiming]:
    """Measure each preset, with the effects that suit the capture, for `seconds` on a device of
    `choose_device`.

    Raises StgaError if the capture has no training views.
    """
    if not capture.views.get("train"):
        raise StgaError(f"{capture.root}: has no training views, so there is nothing to train on")
    for name, preset in PRESETS.items():
        settings, _ = plan_effects(capture, make_settings(preset=name, effects={}), device)
        iterations = preset.iterations_for(len(capture.views["train"]))
        pace = seconds_per_iteration(capture, settings, iterations, seconds, device)
        yield PresetTiming(name, preset.purpose, iterations, iterations * pace)


def seconds_per_iteration(
    capture: Capture,
    settings: TrainingSettings,
    iterations: int,
    seconds: float = CALIBRATION_S,
    device: str = "cpu",
) -> float:
    """Mean time of an iteration of a run of so many, measured by a short one whose result is
    discarded.

    The short run passes through the whole schedule in `seconds`, so that coarse images, spherical
    harmonics, local iterations and growing numbers of splats have the weight that they have in a
    real run. What a run does once, tracking by its avatar included, is shared out among its
    iterations. Reading images is not measured: in a real run, the loader's thread does it.
    """
    precompile_kernels(device)
    selective = settings.strategy == "selective"
    selection = select_capture(capture, settings.selection) if selective else {}
    trainer = Trainer(capture, settings, selection, device=device)
    trainer.prepare_hooks()
    # fractions of the run at which splats are split: by its own count, this one hardly ever would
    (start, end) = settings.density_span
    interval = settings.density_interval
    turns = [n / iterations for n in range(interval, iterations, interval)] if interval else []
    turns = [fraction for fraction in turns if start <= fraction < end]
    left = deque(turns)
    split_s = list[float]()
    density = density_control(settings)
    trainer.hooks["density"] = replace(density, interval=0)
    scales = image_scales(settings, capture.views["train"])
    loaded = _loaded_views(capture, settings, scales)
    times: list[float] = []
    while sum(times[WARM_UP_ITERATIONS:]) < seconds and len(times) < MAX_ITERATIONS:
        progress = min(1.0, sum(times[WARM_UP_ITERATIONS:]) / seconds)
        view, image, mask, mesh = next(loaded[scales[progress >= settings.coarse_share]])
        while left and left[0] <= progress:
            trainer.hooks["density"] = replace(density, interval=1)
            begin = perf_counter()
            trainer.step(view, image, left.popleft(), mask, mesh)
            split_s.append(perf_counter() - begin)
            trainer.hooks["density"] = replace(density, interval=0)
            trainer.step(view, image, progress, mask, mesh)  # not measured: it allocates memory
        begin = perf_counter()
        trainer.step(view, image, progress, mask, mesh)
        times.append(perf_counter() - begin)
    # Each stands for the fraction of the schedule that it takes here: cheap ones are as many as
    # they are quick.
    measured = times[WARM_UP_ITERATIONS:]
    step_s = float(np.average(measured, weights=measured))
    once_s = max(0.0, sum(split_s) - len(split_s) * step_s)
    if settings.tracking and settings.seconds is None:
        once_s += _tracking_seconds(trainer, replace(settings, iterations=iterations))
    return step_s + once_s / iterations


def _loaded_views(
    capture: Capture, settings: TrainingSettings, scales: tuple[float, float]
) -> dict[float, Iterator[LoadedView]]:
    """Scale -> CALIBRATION_VIEWS as the loader gives them, in turn without end."""
    order = view_order(capture.views["train"], settings.views_per_visit, settings.seed)
    views = list(islice(order, CALIBRATION_VIEWS))
    loader = ViewLoader(
        [*views, *views],
        lambda position: scales[position // len(views)],
        settings.background_levels,
        prepare=image_preparation(capture, settings),
        mesh=capture.mesh,
    )
    with loader:
        return {scale: cycle([*islice(loader, len(views))]) for scale in scales}


def _tracking_seconds(trainer: Trainer, settings: TrainingSettings) -> float:
    """What tracking by the avatar takes in a run with the settings, measured on some timesteps; the
    first one, which begins from a single start, is not."""
    capture = trainer.capture
    alone = replace(capture, views={"train": capture.views["train"]})
    trained, every = (views_by_timestep(part.all_views).keys() for part in (alone, capture))
    counts = [
        len(tracked_timesteps(settings, part, sorted(timesteps)))
        for part, timesteps in ((alone, trained), (capture, every - trained))
    ]
    laps: list[float] = []

    def note(done: int, total: int) -> bool:
        laps.append(perf_counter())
        return False

    some = evenly_spread(sorted(trained), TRACKED_TIMESTEPS)
    by = TrainedAvatar(trainer.avatar("", None), settings)
    track_by_avatar(by, alone, some, None, note)
    laps.append(perf_counter())
    return sum(counts) * float(np.mean(np.diff(laps)[min(1, len(some) - 1) :]))
