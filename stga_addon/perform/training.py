"""Training as requests ask for it: a new run, one that is resumed, refined or extended."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..avatar.file import read_avatar, write_avatar
from ..capture.meshes import SELECTED_WEIGHT, find_region
from ..capture.model import Capture, first_timesteps, join_takes, require_same_head, require_same_scale
from ..capture.open import open_capture
from ..errors import StgaError
from ..export.ply import write_ply
from ..format import format_table
from ..progress import Cancelled, Progress, Report, Say
from ..raster.cpu.precompile import begin_compiling
from ..render.device import choose_device
from ..report.run_summary import CurveUpdater, report_run
from ..requests.results import Selected, Written
from ..requests.values import Extend, Refine, Resume, SelectForTake, Train
from ..training.effect_catalog import RELIGHT, WORLD
from ..training.effects.plan import add_effects, describe_effects, plan_effects
from ..training.run.continuation import continued_settings, select_for_takes
from ..training.run.folder import AVATAR, WORLD_FILE, Continuation, Run, Take, has_run, read_run
from ..training.run.identity import file_digest, identity_of
from ..training.run.loop import train
from ..training.run.open_run import OpenedRun, device_of, open_run
from ..training.run.progress import Progress as TrainingProgress
from ..training.run.progress import Report as TrainingReport
from ..training.run.replay import is_faced
from ..training.run.tracking_file import TRACKING, with_refined_tracking
from ..training.settings import with_budget
from ..training.world.world_splats import world_of
from .relighting import add_light

MAX_NAMED_VIEWS = 6
"""Views that a warning names."""
Selection = dict[int, np.ndarray]
"""timestep -> (F,) bool: triangles to train."""


@dataclass(frozen=True)
class Prepared:
    """A run that can be trained into its folder.

    capture    of all its takes
    selection  what each timestep trains, where that is given
    resumes    whether the folder holds the run already
    falls_back see `training.run.loop.train`
    """

    folder: Path
    run: Run
    capture: Capture
    selection: Selection | None
    resumes: bool
    falls_back: bool

    def train(self, report: TrainingReport) -> Path:
        """The path of the avatar. Raises as `training.run.loop.train`."""
        return train(self.capture, self.folder, self.run, self.selection, self.resumes, report, self.falls_back)


def perform_training(request: Train | Resume | Refine | Extend, report: Report, say: Say) -> Written:
    """Train the run that is asked for; returns the path of its avatar and its summary.

    Raises StgaError, and KeyboardInterrupt after Ctrl-C when the run can be resumed.
    """
    prepared = prepare(request, report, say)
    for warning in prepared.capture.warnings:
        say(f"warning: {warning}")
    for line in format_table(describe_effects(prepared.run.effect_plan)):
        say(line)
    draw, latest, is_stopped = CurveUpdater(prepared.folder), Progress(), False

    def report_training(progress: TrainingProgress) -> bool:
        nonlocal latest, is_stopped
        draw()
        latest = _as_progress(progress)
        is_stopped = report(latest)
        return is_stopped

    def report_afterwards(progress: Progress) -> bool:
        return report(replace(latest, stage=progress.stage, preview=None))  # with the figures of the training

    avatar = prepared.train(report_training)
    # Whoever stops a training does not wait for the light; `stga relight` finds it out later.
    light = () if is_stopped else _light_of(prepared, avatar, report_afterwards)
    world = () if is_stopped else _world_of(prepared, report_afterwards)
    lines = [*report_run(prepared.folder), *light, *world, f"avatar: {avatar}"]
    if prepared.run.settings.tracking:
        lines.append(f"refined meshes: {prepared.folder / TRACKING} (in Blender: Apply Motion, Own Offsets)")
    return Written(avatar, tuple(lines))


def _light_of(prepared: Prepared, avatar: Path, report: Report) -> tuple[str, ...]:
    """Write the light of the capture into the avatar; what there is to say about it, or why there is none."""
    if any(decision.effect == RELIGHT and not decision.on for decision in prepared.run.effect_plan):
        return ("light: not estimated (the effect relight is off); `stga relight RUN` estimates it",)
    try:
        return add_light(avatar, with_refined_tracking(prepared.capture, prepared.folder), report=report)
    except StgaError as error:  # an avatar without it is whole
        return (f"light: not estimated ({error})",)


def _world_of(prepared: Prepared, report: Report) -> tuple[str, ...]:
    """Write what stands still behind the person into the run's folder, where its effect is on; what there is to say."""
    if not any(decision.effect == WORLD and decision.on for decision in prepared.run.effect_plan):
        return ()
    path, run = prepared.folder / WORLD_FILE, prepared.run
    try:
        splats = world_of(prepared.capture, run.settings, report)
    except Cancelled:
        return ("world: not made (stopped)",)
    write_ply(path, splats)
    return (f"world: {path} ({len(splats)} splats)",)


def prepare(request: Train | Resume | Refine | Extend, report: Report, say: Say) -> Prepared:
    """Check what is asked for, and decide what is trained and on which device. Raises StgaError."""
    if not isinstance(request, Resume) and has_run(request.run):
        raise StgaError(f"{request.run}: already holds a run; resume it (--resume), or choose another folder (--out)")
    match request:
        case Train():
            prepared = _new_run(request, report, say)
        case Resume():
            prepared = _resumed_run(request, say)
        case Refine():
            prepared = _refinement(request, report, say)
        case Extend():
            prepared = _extension(request, report, say)
    return replace(prepared, falls_back=request.device == "auto")


def select_for_take(request: SelectForTake, report: Report, say: Say) -> Selected:
    """timestep of the take -> (F,) bool: what extending the run by it would train. Raises StgaError."""
    report(Progress(stage="Comparing the avatar with the images"))
    wanted = Extend(request.parent, request.parent, (request.capture,), iterations=1, flame=request.flame)
    _, _, selection, run = _joined_takes(wanted, say)
    start = run.takes[-1].start
    selection = {timestep - start: faces for timestep, faces in selection.items()}
    for timestep, faces in selection.items():
        say(f"{timestep:5d}  {faces.mean():6.1%}")
    return Selected(selection)


def _as_progress(progress: TrainingProgress) -> Progress:
    avatar = progress.avatar

    def preview(path: Path) -> None:
        assert avatar is not None
        with suppress(StgaError):  # training continues without a preview, and reports a full disk itself
            write_avatar(path, avatar())

    shown = None if avatar is None else preview
    return Progress(progress.share, progress.message, progress.forecast_text, progress.figures, shown)


def _new_run(request: Train, report: Report, say: Say) -> Prepared:
    if not request.capture.is_dir():
        raise StgaError(f"{request.capture}: is not a folder; expected that of a capture")
    begin_compiling()
    device, why = choose_device(request.device)
    capture = open_capture(request.capture, request.flame, request.principal_point)
    report(Progress(stage="Analyzing the capture"))
    settings, plan = plan_effects(capture, request.settings, device)
    settings = with_budget(settings, len(capture.views.get("train", ())))
    if settings.iterations != request.settings.iterations:
        say(f"Preset {settings.preset}: {settings.iterations} iterations")
    say(why)
    flame = None if request.flame is None else request.flame.resolve()
    run = Run(capture.root, flame, request.principal_point, settings, plan, device)
    return Prepared(request.run, run, capture, _given(request.selection), resumes=False, falls_back=False)


def _resumed_run(request: Resume, say: Say) -> Prepared:
    opened = open_run(request.run, request.capture, request.flame, request.principal_point)
    device, why = device_of(opened.run, request.device)
    say(why)
    run, selection = replace(opened.run, device=device), _given(request.selection)
    return Prepared(request.run, run, opened.capture, selection, resumes=True, falls_back=False)


def _given(selection: Mapping[int, np.ndarray] | None) -> Selection | None:
    return None if selection is None else dict(selection)


def _refinement(request: Refine, report: Report, say: Say) -> Prepared:
    """Raises StgaError where the run, the region or the frames do not exist, or no camera sees the region."""
    device = _continuing_device(request, say)
    report(Progress(stage="Opening the run"))
    opened = open_run(request.parent, flame=request.flame)
    capture = with_refined_tracking(opened.capture, request.parent)
    region, name = _region(request, capture), request.region or "painted"
    face = read_avatar(request.parent / AVATAR).splats.face
    count = int(region[face].sum())
    if not count:
        raise StgaError(f"region '{name}': the avatar has no splats there")
    settings = continued_settings(
        opened.run.settings, "refine", request.growth * count / len(face), request.seconds, request.iterations,
        request.seed,
    )  # fmt: skip
    frames = request.frames or (min(capture.timesteps), max(capture.timesteps))
    views = [view for view in capture.views.get("train", ()) if frames[0] <= view.timestep <= frames[1]]
    between = f"from timestep {frames[0]} to {frames[1]}"
    if not views:
        raise StgaError(f"{request.parent}: its capture has no training views {between}")
    if not is_faced(capture, views, region):
        raise StgaError(f"region '{name}': faces no training camera {between}")
    continuation = _continuation(request.parent, frames)
    run = replace(opened.run, settings=settings, device=device, identity=None, continuation=continuation)
    return Prepared(request.run, run, capture, {capture.timesteps[0]: region}, resumes=False, falls_back=False)


def _region(request: Refine, capture: Capture) -> np.ndarray:
    """(F,) bool."""
    if request.weights is None:
        return find_region(capture, request.region)
    if request.weights.shape != (len(capture.faces),):
        found = request.weights.shape
        raise StgaError(f"weights: expected one for each triangle ({len(capture.faces)},), got {found}")
    return np.asarray(request.weights >= SELECTED_WEIGHT)


def _extension(request: Extend, report: Report, say: Say) -> Prepared:
    device = _continuing_device(request, say)
    report(Progress(stage="Comparing the avatar with the images"))
    opened, capture, selection, run = _joined_takes(request, say)
    needed = np.any(list(selection.values()), axis=0)
    face = read_avatar(request.parent / AVATAR).splats.face
    growth = request.growth * float(needed[face].mean())
    settings = continued_settings(
        opened.run.settings, "extend", growth, request.seconds, request.iterations, request.seed
    )
    say(f"takes: {1 + len(run.takes)}; the new ones need {needed.mean():.0%} of the triangles")
    settings, plan = add_effects(capture, settings, run.effect_plan)
    for old, new in zip(run.effect_plan, plan, strict=True):
        if new.on != old.on:
            say(f"{new.effect}  {new}")
    run = replace(run, settings=settings, effect_plan=plan, device=device)
    return Prepared(request.run, run, capture, selection, resumes=False, falls_back=False)


def _joined_takes(request: Extend, say: Say) -> tuple[OpenedRun, Capture, Selection, Run]:
    """The run, its capture joined with the new takes, what these train, and the run with them.

    Raises StgaError where the run or a take does not exist, or a take is of another head, has no training views or is
    in the run already. Says which views do not show the head as the avatar does.
    """
    opened = open_run(request.parent, flame=request.flame)
    run, new = opened.run, [_open_new_take(opened, path) for path in request.captures]
    roots = [take.root for take in new]
    twice = next((root for root in roots if roots.count(root) > 1), None)
    if twice is not None:
        raise StgaError(f"{twice}: is given twice; expected each take once")
    everything = [*opened.takes, *new]
    capture = with_refined_tracking(join_takes(everything), request.parent)
    starts = first_timesteps(everything)[len(opened.takes) :]
    added = [
        Take(take.root, start, identity_of(take, run.principal_point, run.settings))
        for take, start in zip(new, starts, strict=True)
    ]
    continuation = _continuation(request.parent, (starts[0], max(capture.timesteps)))
    selection, unlike = select_for_takes(continuation, capture, run.settings, starts)
    if unlike:
        names = ", ".join(view.name for view in unlike[:MAX_NAMED_VIEWS])
        say(f"warning: {names}: does not look like the head from this camera; are images swapped?")
    run = replace(run, identity=None, takes=(*run.takes, *added), continuation=continuation)
    return opened, capture, selection, run


def _open_new_take(opened: OpenedRun, path: Path) -> Capture:
    run = opened.run
    take = open_capture(path, run.flame, run.principal_point)
    require_same_head(opened.capture, take)
    if not take.views.get("train"):
        raise StgaError(f"{take.root}: has no training views, so there is nothing to extend the avatar with")
    require_same_scale(opened.takes[0], take)
    if any(take.root == old.root for old in opened.takes):
        raise StgaError(f"{take.root}: is a take of this run already")
    return take


def _continuation(parent: Path, frames: tuple[int, int]) -> Continuation:
    return Continuation(parent.resolve(), file_digest(parent / AVATAR), *frames)


def _continuing_device(request: Refine | Extend, say: Say) -> str:
    device, why = device_of(read_run(request.parent), request.device)
    say(f"{why}\nrun: {request.run}")
    return device
