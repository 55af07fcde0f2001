"""What a capture calls for before it is trained: effects, time, and the triangles that move."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import monotonic

from ..capture.open import is_capture, open_capture, repair_capture
from ..capture.other_input import other_input
from ..capture.repairs import REPAIR_OPTION
from ..capture.selection import SelectionOptions, select_capture
from ..format import format_duration
from ..options import When, like
from ..progress import Log, Progress, Report
from ..raster.devices import choose_device
from ..training.effect_catalog import EffectDecision
from ..training.run.folder import RUN
from ..training.settings import PRESETS, TrainingSettings, make_settings
from .train import Selected, Train

FRACTIONS = (0.1, 0.35, 0.65)
"""Fractions of an analysis that are done when each preset begins to be timed."""


@dataclass(frozen=True)
class _OfCapture:
    capture: Path = like(Train, "capture")
    flame: Path | None = like(Train, "flame")
    principal_point: str = like(Train, "principal_point")


def holds_avatar(path: Path) -> bool:
    """Whether a path is that of a run or an avatar file."""
    return (path / RUN).exists() or path.suffix == ".npz"


def _may_be_capture(path: Path) -> bool:
    return not holds_avatar(path) and (is_capture(path) or other_input(path) is None)


CAPTURED = When(
    lambda value: value.capture is None or _may_be_capture(value.capture),
    "on {capture}, which is no capture",
)


@dataclass(frozen=True)
class Analyze(_OfCapture):
    """Show what a capture holds, and which effects training on it would use; or what a run or
    avatar file holds.

    timed: whether presets are timed as well, which takes longer.
    """

    flame: Path | None = like(Train, "flame", needs=(CAPTURED,))
    principal_point: str = like(Train, "principal_point", needs=(CAPTURED,))
    effects: Mapping[str, str] | None = like(TrainingSettings, "effects", needs=(CAPTURED,))
    device: str = like(Train, "device", needs=(CAPTURED,))
    timed: bool = False
    LATER_FIELDS = ("repair",)
    repair: bool = like(Train, "repair", needs=(CAPTURED,))


@dataclass(frozen=True)
class TimePresets(_OfCapture):
    """Show the presets, and how long each would train on this machine."""

    device: str = like(Train, "device")


@dataclass(frozen=True)
class Select(_OfCapture):
    """Show which triangles each frame selects for training."""

    threshold: float = like(SelectionOptions, "threshold")
    zero_pose: str | None = like(
        SelectionOptions,
        "zero_pose",
        default=None,
        help="motion that does not count as expression (default head)",
    )


@dataclass(frozen=True)
class Analyzed:
    """Effects that a capture calls for. seconds: preset -> training time on this machine.
    misfit: how a mesh that misses its images would fit them. repaired: whether it does so now."""

    plan: tuple[EffectDecision, ...]
    seconds: Mapping[str, float]
    misfit: str = ""
    repaired: bool = False


def analyze(request: Analyze, report: Report, log: Log) -> Analyzed:
    """Decide the effects of a training on the capture; also times the presets if asked to. Raises
    StgaError."""
    from ..training.effects.plan import plan_effects

    begin = monotonic()
    report(Progress(stage="Analyzing the capture"))
    source = request.capture, request.flame, request.principal_point
    repaired = repair_capture(*source) if request.repair else None
    if repaired:
        log(repaired)
    capture = open_capture(*source)
    if not capture.views.get("train"):
        return Analyzed((), {})
    device, _ = choose_device(request.device)
    settings = make_settings(iterations=1, effects=dict(request.effects or {}))
    _, plan = plan_effects(capture, settings, device)
    seconds: dict[str, float] = {}
    if request.timed:
        # imports Numba, which deciding effects does without
        from ..training.preset_timing import time_presets

        timings = time_presets(capture, device=device)
        for fraction, preset in zip(FRACTIONS, PRESETS, strict=True):
            left_s = partial(dict[str, float], left_s=(monotonic() - begin) * (1 / fraction - 1))
            report(Progress(fraction, "Timing the presets", figures=left_s))
            seconds[preset] = next(timings).seconds
    misfit = next((text for text in capture.warnings if REPAIR_OPTION in text), "")
    return Analyzed(plan, seconds, misfit, repaired is not None)


def time_each_preset(request: TimePresets, report: Report, log: Log) -> Analyzed:
    """Time the presets; says what each is for. Raises StgaError."""
    from ..training.preset_timing import time_presets

    capture = open_capture(request.capture, request.flame, request.principal_point)
    device, why = choose_device(request.device)
    log(why)
    timings = []
    for timing in time_presets(capture, device=device):
        timings.append(timing)
        log(
            f"{timing.preset:<9} {timing.iterations:6d} iterations  about "
            f"{format_duration(timing.seconds):<10}  {timing.purpose}"
        )
    return Analyzed((), {timing.preset: timing.seconds for timing in timings})


def select(request: Select, report: Report, log: Log) -> Selected:
    """Say how much each timestep selects, and which regions as a whole. Raises StgaError."""
    capture = open_capture(request.capture, request.flame, request.principal_point)
    options = SelectionOptions(request.threshold, request.zero_pose or SelectionOptions.zero_pose)
    selection = select_capture(capture, options)
    log(f"threshold {1000 * request.threshold:g} mm, {len(capture.faces)} triangles")
    for timestep, faces in selection.items():
        regions = (name for name, r in capture.regions.items() if r.any() and faces[r].all())
        log(f"{timestep:5d}  {faces.mean():6.1%}  {', '.join(regions)}")
    return Selected(selection)
