"""Continuing a finished run in another folder: refining a region of its avatar, or extending it by further takes."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ...avatar.file import read_avatar
from ...capture.model import Capture, View
from ...capture.region import find_region
from ...errors import StgaError
from ...raster.cpu.layout import Parameters
from ..evaluate.evaluation_views import (
    MAX_EVALUATION_VIEWS,
    MIN_REGION_PIXELS,
    EvaluationView,
    read_evaluation_view,
    spread_views,
    visible_pixels,
)
from ..optimize.state import TrainState, new_state
from ..optimize.tracking import with_refined_tracking
from ..settings import Rates, TrainingSettings, validate
from .checkpoint import read_checkpoint
from .folder import CHECKPOINT, Continuation, Run
from .identity import file_digest
from .open_run import open_run

START_SHARE = 0.6
"""Share of the run's schedule of learning rates that has passed when its continuation begins."""
DENSITY_INTERVAL, DENSITY_SPAN = 40, (0.0, 0.6)
"""Density control of a continuation, whose budget is a tenth of a training's."""
MIN_GROUP_VIEWS = 4
"""Evaluation views of a group at least, where it has so many."""


@dataclass(frozen=True)
class Refinement:
    """What is asked of a continuation that refines a region.

    parent   folder of the run
    region   name of a region, or region file (`find_region`)
    frames   timesteps from first to last whose images show what is wrong; None: all
    growth   most splats that may be added, as a share of the region's
    seconds, iterations   the budget, one of the two
    """

    parent: Path
    region: str
    frames: tuple[int, int] | None = None
    growth: float = 0.0
    seconds: float | None = None
    iterations: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class Prepared:
    """A continuation that can be trained: the run, its capture of all takes, and timestep -> triangles to train."""

    run: Run
    capture: Capture
    selection: dict[int, np.ndarray]


def prepare_refinement(wanted: Refinement, device: str, flame: Path | None = None) -> Prepared:
    """Check what is asked for. Raises StgaError where the run, the region or the frames do not exist."""
    opened = open_run(wanted.parent, flame=flame)
    capture = with_refined_tracking(opened.capture, wanted.parent)
    region = find_region(capture, wanted.region)
    face = read_avatar(wanted.parent / "avatar.npz").splats.face
    count = int(region[face].sum())
    if not count:
        raise StgaError(f"region '{wanted.region}': the avatar has no splats there")
    settings = continued_settings(
        opened.run.settings, "refine", wanted.growth * count / len(face), wanted.seconds, wanted.iterations, wanted.seed
    )
    frames = wanted.frames or (min(capture.timesteps), max(capture.timesteps))
    if not any(frames[0] <= view.timestep <= frames[1] for view in capture.views.get("train", ())):
        raise StgaError(f"{wanted.parent}: its capture has no training views from timestep {frames[0]} to {frames[1]}")
    run = replace(
        opened.run,
        settings=settings,
        device=device,
        identity=None,
        continuation=Continuation(wanted.parent.resolve(), file_digest(wanted.parent / "avatar.npz"), *frames),
    )
    return Prepared(run, capture, {capture.timesteps[0]: region})


def starting_state(continuation: Continuation) -> TrainState:
    """The parent's avatar as a state of training.

    The optimizer continues where the parent's checkpoint is of that very avatar; otherwise its moments are zero.
    Raises StgaError where the avatar is not the one that the continuation was made for.
    """
    folder = continuation.parent
    if file_digest(folder / "avatar.npz") != continuation.avatar:
        raise StgaError(f"{folder / 'avatar.npz'}: has changed since this continuation was started from it")
    splats = read_avatar(folder / "avatar.npz").splats
    if (folder / CHECKPOINT).exists():
        state = read_checkpoint(folder).state
        kept = state.averaged()
        if all(np.array_equal(array, getattr(kept, name)) for name, array in vars(splats).items()):
            parameters = Parameters(*(tensor.clone() for tensor in state.average))
            zero = torch.zeros(len(state))
            return replace(state, parameters=parameters, screen_gradient=zero, gradient_count=zero.clone())
    return new_state(splats)


def late_rates(rates: Rates, share: float) -> Rates:
    """The rates of a schedule of which this share has passed; they end where the schedule ends."""
    names = [name for name in vars(rates) if name not in ("position_end", "end")]
    ends = {name: rates.position_end if name == "xyz" else rates.end for name in names}
    now = {name: getattr(rates, name) * ends[name] ** share for name in names}
    rest = {"position_end": rates.position_end ** (1 - share), "end": rates.end ** (1 - share)}
    return replace(rates, **now, **rest)


def continued_settings(
    settings: TrainingSettings,
    strategy: str,
    growth: float,
    seconds: float | None,
    iterations: int | None,
    seed: int,
) -> TrainingSettings:
    """The settings of a run for its continuation by one of CONTINUATIONS. Raises StgaError for a value not allowed."""
    continued = replace(
        settings,
        strategy=strategy,
        seconds=seconds,
        iterations=iterations,
        seed=seed,
        rates=late_rates(settings.rates, START_SHARE),
        views_per_visit=1,
        warm_up_share=0.0,
        sh_steps=(0.0,) * settings.sh_degree,
        coarse_share=0.0,
        density_interval=DENSITY_INTERVAL if growth else 0,
        density_span=DENSITY_SPAN,
        growth=growth,
        target_psnr=None,
        stop_when_flat=False,
        tracking=False,
        effects=None,
    )
    validate(continued)
    return continued


def continued_evaluation_views(run: Run, capture: Capture, region: np.ndarray | None) -> list[EvaluationView]:
    """Evaluation views of a run that continues another, in groups: by take, or frames that are refined and others.

    region (F,) bool: its visible pixels become the views' region "region"; None for an extension.
    """
    groups: dict[str, list[View]] = {}
    for view in capture.views.get("val", ()):
        groups.setdefault(_group(run, view.timestep), []).append(view)
    limit, chosen = max(MIN_GROUP_VIEWS, MAX_EVALUATION_VIEWS // max(1, len(groups))), []
    for group, members in groups.items():
        for view in spread_views(members, limit):
            found = replace(read_evaluation_view(capture, view), group=group)
            pixels = np.zeros(0) if region is None else visible_pixels(capture, view, region)
            if pixels.sum() >= MIN_REGION_PIXELS:
                found = replace(found, regions={**found.regions, "region": pixels})
            chosen.append(found)
    return chosen


def _group(run: Run, timestep: int) -> str:
    assert run.continuation is not None
    if run.settings.strategy == "extend":
        return f"take_{1 + sum(take.start <= timestep for take in run.takes)}"
    return "frames" if run.continuation.includes(timestep) else "other_frames"
