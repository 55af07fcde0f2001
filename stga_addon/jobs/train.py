"""Training: a new run, one that is resumed, and one that refines or extends a finished run."""

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..avatar.file import Avatar, read_avatar
from ..capture.meshes import SELECTED_WEIGHT, find_region, is_region_file
from ..capture.model import Capture
from ..capture.open import open_capture, repair_capture
from ..capture.repairs import REPAIR_OPTION
from ..capture.takes import further_takes, join_takes
from ..capture.transforms import DEFAULT_PRINCIPAL_POINT, PRINCIPAL_POINTS
from ..errors import StgaError
from ..export.ply import write_ply
from ..files import file_digest
from ..format import format_table
from ..options import like, option
from ..progress import Cancelled, Log, Progress, Report, Written
from ..raster.devices import EXPECTED_DEVICE, choose_device, is_device
from ..schema import setting
from ..training.effect_catalog import RELIGHT, WORLD
from ..training.run import folder as run_folder
from ..training.run.folder import AVATAR, Continuation, Run
from ..training.run.report import CurveUpdater, report_run
from ..training.settings import MAX_ADDED_RATIO, TrainingSettings, with_budget

if TYPE_CHECKING:
    from ..training.run.session import Trained

AFTERWARDS = (StgaError, Cancelled, MemoryError)
"""Exceptions that may end the work after a training; its avatar is complete without that work."""
AFTER_S = 20.0
"""Seconds that light and world take after a training, about."""
AFTER_FRACTION = 0.05
"""Fraction of the progress that they take."""
Selection = Mapping[int, np.ndarray]  # timestep -> (F,) bool: triangles to train


@dataclass(frozen=True)
class Train:
    """Train an avatar from a capture, or continue a run.

    selection: trained instead of what the rule selects. takes: further captures of the same head,
    with which the capture takes turns.
    """

    run: Path = option("folder of the run", flag="--out", metavar="RUN")
    capture: Path = option("folder of the capture", flag="CAPTURE")
    settings: TrainingSettings = setting()
    flame: Path | None = option("FLAME model file (.pkl or .npz)", None, metavar="FILE")
    principal_point: str = option(
        "what cy means in the capture", DEFAULT_PRINCIPAL_POINT, choices=PRINCIPAL_POINTS
    )
    device: str = option(
        "gpu: the first graphics adapter; gpu:NAME: the one whose name has this part; auto "
        "(default): that of the run, else a GPU if it is right and faster than the CPU in a trial "
        "of a second, else the CPU",
        "auto",
        accepts=is_device,
        expected=EXPECTED_DEVICE,
        metavar="{auto,cpu,gpu,gpu:NAME}",
    )
    selection: Selection | None = None
    LATER_FIELDS = ("takes", "repair")
    takes: tuple[Path, ...] = ()
    repair: bool = option(
        "if the mesh misses the images, read the capture in the way that fits, from now on", False
    )


@dataclass(frozen=True)
class Resume:
    """Continue a run that was stopped, or train one further.

    capture, flame, principal_point   stand in for those that the run was begun with; None: these
    selection       where training has not begun
    more_s          seconds to train from its checkpoint on; None: what is left of its budget
    """

    run: Path
    capture: Path | None = None
    flame: Path | None = None
    principal_point: str | None = setting(None, choices=PRINCIPAL_POINTS)
    device: str = like(Train, "device")
    selection: Selection | None = None
    more_s: float | None = setting(None, above=0)


def resumed(request: "Train | Refine | Extend") -> "Train | Resume | Refine | Extend":
    """What continues the run of a request, where it has begun one; else the request."""
    if not run_folder.has_run(request.run):
        return request
    names: tuple[str, ...] = ("run", "flame", "device")
    if isinstance(request, Train):
        names = (*names, "capture", "principal_point", "selection")
    return Resume(**{name: getattr(request, name) for name in names})


@dataclass(frozen=True)
class _Continue:
    """Continue a finished run in a run of its own. seconds, iterations: one of the two."""

    run: Path = option(
        "folder of the run that continues it (default: RUN_2, RUN_3, …)",
        flag="--out",
        metavar="NEW",
    )
    parent: Path = option("folder of a run", flag="RUN")
    _: KW_ONLY
    growth: float = option(
        "splats to add, as a fraction of those on the triangles that are trained",
        0.0,
        0,
        MAX_ADDED_RATIO,
        metavar="FRACTION",
    )
    seconds: float | None = like(TrainingSettings, "seconds", help="training time")
    iterations: int | None = like(TrainingSettings, "iterations")
    seed: int = like(TrainingSettings, "seed")
    flame: Path | None = like(Train, "flame", help="FLAME model file, if it has moved")
    device: str = like(Train, "device")

    def check(self) -> None:
        """Raise StgaError unless there is one budget."""
        if (self.seconds is None) == (self.iterations is None):
            raise StgaError("the budget must be given either in seconds or in iterations")


@dataclass(frozen=True)
class Refine(_Continue):
    """Train one region of a finished avatar further; every other splat stays as it is, and so does
    the run.

    weights: (F,) of each triangle of a painted region, instead of `region`.
    """

    region: str = option(
        "region of the capture, vertex mask of FLAME, or file of triangle weights "
        "(docs/formats.md); required without --resume",
        "",
        metavar="NAME|FILE",
        is_path=is_region_file,
    )
    weights: np.ndarray | None = None
    frames: tuple[int, int] | None = option(
        "timesteps to train on (default: all)", None, 0, metavar="FIRST-LAST"
    )
    _: KW_ONLY
    seconds: float | None = like(_Continue, "seconds", help="training time (default 20s)")

    def check(self) -> None:
        """Raise StgaError unless there is one region and one budget."""
        if not self.region and self.weights is None:
            raise StgaError(
                "--region: is missing; expected the name of a region or a file of triangle weights"
            )
        if self.region and self.weights is not None:
            raise StgaError("region: expected its name, its file or painted weights")
        super().check()


@dataclass(frozen=True)
class Extend(_Continue):
    """Extend a finished avatar by further takes of the same head, in a run of its own."""

    captures: tuple[Path, ...] = option(
        "captures of the same head, or footage, which the avatar tracks; required without --resume",
        flag="CAPTURE",
    )
    _: KW_ONLY
    seconds: float | None = like(_Continue, "seconds", help="training time (default 1m)")

    def check(self) -> None:
        """Raise StgaError unless there is a take and one budget."""
        if not self.captures:
            raise StgaError("CAPTURE: is missing; expected one or more takes to extend the run by")
        super().check()


@dataclass(frozen=True)
class Selected:
    """timestep -> (F,) bool: triangles."""

    selection: Selection


Training = Train | Resume | Refine | Extend


@dataclass(frozen=True)
class Prepared:
    """A run that can be trained: the capture of all its takes, and what each timestep trains.

    parent  the avatar that it continues, which is held so that `read_avatar` reads its file once
    """

    request: Training
    run: Run
    capture: Capture
    selection: Selection | None = None
    parent: Avatar | None = None

    def train_as_asked(self, report: Report) -> "Trained":
        """Train on the device of the request, or the one chosen for it. Raises as
        `training.run.session.train_run`."""
        from ..training.run.session import train_more, train_run, train_run_or_fall_back

        if isinstance(self.request, Resume) and self.request.more_s is not None:
            return train_more(self.capture, self.request.run, self.run, self.request.more_s, report)
        is_auto = self.request.device == "auto"
        train = train_run_or_fall_back if is_auto else train_run
        resumes = isinstance(self.request, Resume)
        return train(self.capture, self.request.run, self.run, self.selection, resumes, report)


def train_and_finish(request: Training, report: Report, log: Log) -> Written:
    """Train the run that is asked for, and add its summary, light and world. Raises StgaError,
    KeyboardInterrupt after Ctrl-C."""
    from ..training.effects.plan import describe_effects

    prepared = prepare(request, report, log)
    folder = request.run
    draw = CurveUpdater(folder)
    for warning in prepared.capture.warnings:
        log(f"warning: {warning}")
    effects = describe_effects(prepared.run.effect_plan)
    for line in format_table(effects):
        log(line)
    choices = {decision.effect: decision.on for decision in prepared.run.effect_plan}
    after = [choices.get(RELIGHT, True), choices.get(WORLD, False)]
    latest = Progress()
    is_stopped = False

    def report_part(progress: Progress, done: float) -> bool:
        """Report training, or with its figures what comes after it, of which `done` is done."""
        figures = {"left_s": math.nan, **latest.figures()}
        training_s = figures["left_s"] if progress is latest else 0.0
        figures["left_s"] = training_s + AFTER_S * (sum(after) - done)
        fraction = latest.fraction * (1 - AFTER_FRACTION * sum(after)) + AFTER_FRACTION * done
        return report(replace(progress, fraction=fraction, figures=lambda: figures))

    def report_training(progress: Progress) -> bool:
        nonlocal latest, is_stopped
        draw(progress.metrics)
        latest = progress
        is_stopped = report_part(progress, 0.0)
        return is_stopped

    def report_light(progress: Progress) -> bool:
        return report_part(progress, progress.fraction)

    def report_world(progress: Progress) -> bool:
        return report_part(progress, after[0] + progress.fraction)

    trained = prepared.train_as_asked(report_training)
    avatar = trained.path
    report_part(Progress(stage="Drawing the curve"), 0.0)
    lines = report_run(folder, latest.metrics)
    # whoever stops a training does not wait; `stga relight` finds the light out later
    if not is_stopped:
        lines += _light_of(prepared, avatar, report_light)
        if after[1]:
            lines.append(_world_of(prepared, report_world))
    lines.append(f"avatar: {avatar}")
    if prepared.run.settings.tracking:
        lines.append(
            f"refined meshes: {folder / run_folder.TRACKING} (in Blender: Apply Motion, Own "
            "Offsets)"
        )
    return Written(avatar, tuple(lines))


def _light_of(prepared: Prepared, avatar: Path, report: Report) -> tuple[str, ...]:
    """Write the light of the capture into the avatar; what there is to say, or why it has none."""
    if any(decision.effect == RELIGHT and not decision.on for decision in prepared.run.effect_plan):
        return (
            "light: not estimated (the effect relight is off); `stga relight RUN` estimates it",
        )
    from .finished_run import add_light

    capture = run_folder.with_refined_tracking(prepared.capture, prepared.request.run)
    try:
        return add_light(avatar, capture, report=report)
    except AFTERWARDS as error:
        return (f"light: not estimated ({_reason(error)})",)


def _reason(error: BaseException) -> str:
    return "not enough memory" if isinstance(error, MemoryError) else str(error) or "stopped"


def _world_of(prepared: Prepared, report: Report) -> str:
    """Write what stands still behind the person; what there is to say."""
    from ..training.world import world_of

    path = prepared.request.run / run_folder.WORLD_FILE
    try:
        splats = world_of(prepared.capture, prepared.run.settings, report)
    except AFTERWARDS as error:
        return f"world: not made ({_reason(error)})"
    write_ply(path, splats)
    return f"world: {path} ({len(splats)} splats)"


def refuse_run(request: Train | Refine | Extend) -> None:
    """Raise StgaError where the folder of the new run holds one."""
    if run_folder.has_run(request.run):
        raise StgaError(f"{request.run}: already holds a run; resume it, or choose another folder")


def require_run(request: Resume) -> None:
    """Raise StgaError where there is no run to resume, or a damaged one."""
    run_folder.read_run(request.run)


def avatar_file(request: Train | Refine | Extend) -> tuple[Path]:
    """What a finished run has."""
    return (request.run / AVATAR,)


def prepare(request: Training, report: Report, log: Log) -> Prepared:
    """Check what is asked for, and decide what is trained and on which device. Raises StgaError."""
    if isinstance(request, Resume):
        flame = request.flame
        principal_point = request.principal_point
        opened = run_folder.open_run(request.run, request.capture, flame, principal_point)
        device, why = run_folder.device_of(opened.run, request.device)
        log(why)
        run = replace(opened.run, device=device)
        return Prepared(request, run, opened.capture, request.selection)
    refuse_run(request)
    if isinstance(request, Train):
        return _new_run(request, report, log)
    device, why = run_folder.device_of(run_folder.read_run(request.parent), request.device)
    log(f"{why}\nrun: {request.run}")
    begin: Any = _refinement if isinstance(request, Refine) else _extension
    prepared: Prepared = begin(request, report, log)
    return replace(prepared, run=replace(prepared.run, device=device))


def _new_run(request: Train, report: Report, log: Log) -> Prepared:
    from ..raster.cpu.precompile import begin_compiling
    from ..training.effects.plan import plan_effects

    if not request.capture.is_dir():
        open_capture(request.capture)  # says what it is
    begin_compiling()
    device, why = choose_device(request.device)
    source = request.capture, request.flame, request.principal_point
    if request.repair and (repaired := repair_capture(*source)):
        log(repaired)
    opened = open_capture(*source)
    if opened.repair is not None:
        raise StgaError(next(text for text in opened.warnings if REPAIR_OPTION in text))
    new = further_takes(request.takes, [opened], request.flame, request.principal_point)
    every = [opened, *new]
    capture = join_takes(every)
    expected_s = (request.settings.seconds or math.nan) + AFTER_S
    report(Progress(stage="Analyzing the capture", figures=lambda: {"left_s": expected_s}))
    settings, plan = plan_effects(capture, request.settings, device)
    settings = with_budget(settings, len(capture.views.get("train", ())))
    if settings.iterations != request.settings.iterations:
        log(f"Preset {settings.preset}: {settings.iterations} iterations")
    log(why)
    flame = None if request.flame is None else request.flame.resolve()
    run = Run(capture.root, flame, request.principal_point, settings, plan, device)
    run = replace(run, takes=run_folder.named_takes(every, 1, run))
    return Prepared(request, run, capture, request.selection)


def _refinement(request: Refine, report: Report, log: Log) -> Prepared:
    """Raises StgaError without run, region or frames, or where no camera sees the region."""
    from ..training.run.continuation import continued_settings, is_faced

    parent = request.parent
    weights = request.weights
    report(Progress(stage="Opening the run"))
    opened = run_folder.open_run(parent, flame=request.flame)
    capture = run_folder.with_refined_tracking(opened.capture, parent, fitted=False)
    count = len(capture.faces)
    if weights is None:
        region = find_region(capture, request.region)
        name = request.region
    elif weights.shape == (count,):
        region = weights >= SELECTED_WEIGHT
        name = "painted"
    else:
        raise StgaError(f"weights: expected one for each triangle ({count},), got {weights.shape}")
    avatar = read_avatar(parent / AVATAR)
    face = avatar.splats.face
    if not region[face].any():
        raise StgaError(f"region '{name}': the avatar has no splats there")
    growth = request.growth * float(region[face].mean())
    settings = continued_settings(
        opened.run.settings, "refine", growth, request.seconds, request.iterations, request.seed
    )
    first, last = request.frames or (min(capture.timesteps), max(capture.timesteps))
    views = [v for v in capture.views.get("train", ()) if first <= v.timestep <= last]
    between = f"from timestep {first} to {last}"
    if not views:
        raise StgaError(f"{parent}: its capture has no training views {between}")
    if not is_faced(capture, views, region):
        raise StgaError(f"region '{name}': faces no training camera {between}")
    continuation = Continuation(parent.resolve(), file_digest(parent / AVATAR), first, last)
    run = replace(opened.run, settings=settings, identity=None, continuation=continuation)
    return Prepared(request, run, capture, {capture.timesteps[0]: region}, avatar)


def _extension(request: Extend, report: Report, log: Log) -> Prepared:
    from ..training.effects.plan import add_effects
    from ..training.run.continuation import continued_settings

    report(Progress(stage="Opening the takes"))
    avatar = read_avatar(request.parent / AVATAR)
    capture, run = _joined_takes(request)
    budget = (request.seconds, request.iterations)
    settings = continued_settings(run.settings, "extend", request.growth, *budget, request.seed)
    log(f"takes: {1 + len(run.takes)}")
    settings, plan = add_effects(capture, settings, run.effect_plan)
    for old, new in zip(run.effect_plan, plan, strict=True):
        if new.on != old.on:
            log(f"{new.effect}  {new}")
    run = replace(run, settings=settings, effect_plan=plan)
    return Prepared(request, run, capture, {}, avatar)


def _joined_takes(request: Extend) -> tuple[Capture, Run]:
    """The capture of the run joined with the new takes, and the run with them.

    Raises StgaError where the run or a take does not exist, or a take is of another head, has no
    training views or is in the run already.
    """
    opened = run_folder.open_run(request.parent, flame=request.flame)
    run = opened.run
    new = further_takes(request.captures, opened.takes, run.flame, run.principal_point)
    everything = [*opened.takes, *new]
    joined = join_takes(everything)
    capture = run_folder.with_refined_tracking(joined, request.parent, fitted=False)
    added = run_folder.named_takes(everything, len(opened.takes), run)
    parent = request.parent
    last = max(capture.timesteps)
    continuation = Continuation(
        parent.resolve(), file_digest(parent / AVATAR), added[0].start, last
    )
    run = replace(run, identity=None, takes=(*run.takes, *added), continuation=continuation)
    return capture, run
