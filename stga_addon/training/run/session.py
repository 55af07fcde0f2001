"""Training of a run in its folder: begun or resumed; steps, evaluations and checkpoints."""

import logging
import math
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from shutil import copyfile
from time import perf_counter
from typing import NamedTuple

import numpy as np

from ...avatar.file import Avatar, read_avatar, write_avatar
from ...capture.loader import DEFAULT_LIMITS, ViewLoader
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from ...capture.selection import select_capture
from ...capture.usable_views import with_training_views, without_training_views
from ...errors import DeviceError, StgaError, shorten
from ...files import replacing
from ...progress import Cancelled, Progress, Report, ignore
from ...raster.cpu.threads import threads
from ...render.render import render_avatar
from ...tracking.folder import is_in_order
from ..evaluate import lpips, metrics
from ..evaluate.evaluator import EVALUATIONS, Evaluator, Spent
from ..evaluate.forecast import UNMATCHED
from ..evaluate.metrics import RESIDUAL_SCALE, triangle_residuals
from ..optimize.avatar_tracking import (
    MAX_HEIGHT_PX,
    AvatarTracking,
    RefinedTracking,
    TrainedAvatar,
    not_moved,
    read_small,
    track_by_avatar,
    tracked_timesteps,
)
from ..optimize.image_preparation import image_preparation
from ..optimize.precompile import precompile_kernels
from ..optimize.state import TrainState
from ..optimize.trainer import Start, Trainer
from ..schedule import image_scales, take_order
from . import checkpoint as checkpoints
from . import folder as folders
from .continuation import (
    START_FRACTION,
    continued_order,
    grouped_evaluation_views,
    starting_state,
)
from .folder import AVATAR, CHECKPOINT, TRACKING, Run
from .metrics_log import (
    METRICS,
    REGION_PSNR,
    TRACKING_GAIN,
    append_metrics,
    cut_metrics,
)

_log = logging.getLogger(__name__)
"""Log of warnings during training."""
CHECKPOINT_S = 30.0
"""Seconds of training between checkpoints: what a crash may cost."""
CHECKPOINT_VARIABLE = "STGA_CHECKPOINT_S"
"""Environment variable that replaces it, for machines that are taken away often."""
TRACKING_START_FRACTION = 0.5
"""Fraction of the budget after which the avatar tracks its head."""
TRACKING_TIME_FRACTION = 0.2
"""Fraction of the seconds that this tracking may take."""
LEFT_OUT_INTERVAL = 12
"""Every how many timesteps one is left out of that tracking where no camera is held out."""
LEFT_OUT_VIEWS = 24
"""Views that decide whether the tracking is kept."""
MIN_TIMESTEPS_TO_LEAVE_OUT = 3
"""Timesteps of the training from which on some are left out."""
UNCHECKED = (
    "no held-out view shows a trained timestep, and no trained timestep lies between two others"
)
"""Why a tracking is kept unchecked."""
SET_ASIDE = {AVATAR: "avatar_to_resume.npz", TRACKING: "tracking_to_resume.npz"}
"""Files of a stopped run that belong to its evaluation -> those that an unbroken run would have,
put back when it is resumed."""
Selection = Mapping[int, np.ndarray]
"""timestep -> (F,) bool: triangles."""
RECENT_LOSSES = 100
"""Global iterations that the loss in messages and metrics is the mean of."""
RESIDUAL_VIEWS = 24
"""Views in which the residuals of a finished run are measured."""
READERS_BESIDE_CPU = 0.2
"""Threads that decode images beside a training on the CPU, as a fraction of its own."""
READERS_BESIDE_GPU = 0.5
"""The same beside one on the GPU, as a fraction of those that kernels would run on."""


def image_readers(device: str) -> int:
    """How many images are decoded at a time beside a training on a device."""
    fraction = READERS_BESIDE_CPU if device == "cpu" else READERS_BESIDE_GPU
    return max(1, round(fraction * threads()))


class Trained(NamedTuple):
    """An avatar file that a training has written, and its avatar where it was read to be measured:
    `read_avatar` does not read the file again while somebody holds it."""

    path: Path
    avatar: Avatar | None


def train_run_or_fall_back(
    capture: Capture,
    out: Path,
    run: Run,
    selection: Selection | None = None,
    resume: bool = False,
    report: Report = ignore,
) -> Trained:
    """`train_run`; where a GPU fails, the CPU continues, from the last checkpoint if any."""
    try:
        return train_run(capture, out, run, selection, resume, report)
    except DeviceError as error:
        _log.warning("%s; continuing on the CPU", error.cause)
    # Outside the handler: the error's traceback would keep the failed loop and its buffers alive.
    report(Progress(stage="Continuing on the CPU"))
    return train_run(capture, out, replace(run, device="cpu"), selection, True, report)


def train_run(
    capture: Capture,
    out: Path,
    run: Run,
    selection: Selection | None = None,
    resume: bool = False,
    report: Report = ignore,
) -> Trained:
    """Train a capture into the folder `out`, and measure the error of the avatar by triangle.

    selection: instead of the rule's. With `resume`, continues from the folder's checkpoint to the
    parameters that an unbroken run would have reached (same seed, number of threads and device).
    Raises StgaError where the capture has nothing to train on, the folder is in use, is the
    capture's or holds another run or one that cannot be continued, or STGA_LPIPS names a file
    without its weights; DeviceError where a GPU fails. A first Ctrl-C raises KeyboardInterrupt when
    avatar and checkpoint are saved, a second one at once.
    """
    lpips.load_network()  # read now, because it is needed only when everything is trained
    if not capture.views.get("train"):
        raise StgaError(f"{capture.root}: has no training views, so there is nothing to train on")
    if run.settings.target_psnr is not None and not capture.views.get("val"):
        raise StgaError(
            f"--target-psnr: {capture.root} has no held-out views (split 'val') to measure it on"
        )
    if out.resolve() == capture.root:
        raise StgaError(f"{out}: is the folder of the capture; train into another one")
    with folders.locked(out):
        exists = folders.has_run(out)
        if exists and not resume:
            raise StgaError(f"{out}: already holds a run; resume it, or choose another folder")
        has_begun = exists and folders.read_run(out).identity is not None
        run = replace(run, identity=folders.check_identity(out, run, capture))
        capture = _usable(capture, run)
        if has_begun and (out / CHECKPOINT).exists():
            session = _resume(capture, out, run, report)
        else:
            if has_begun and selection is None and (out / folders.SELECTION).exists():
                selection = checkpoints.read_selection(out, len(capture.faces), run.digest)
            session = _begin(capture, out, run, selection, report)
        session.complete()
    return Trained(out / AVATAR, session.measured)


def train_more(
    capture: Capture, out: Path, run: Run, seconds: float, report: Report = ignore
) -> Trained:
    """Train the run in the folder `out` for so many seconds more than it was, whether its budget is
    spent or not, by the later part of its schedule. Raises as `train_run` does."""
    lpips.load_network()
    with folders.locked(out):
        run = replace(run, identity=folders.check_identity(out, run, capture))
        capture = _usable(capture, run)
        session = _resume(capture, out, run, report)
        session.begin_addition(seconds)
        session.complete()
    return Trained(out / AVATAR, session.measured)


def _usable(capture: Capture, run: Run) -> Capture:
    """The capture without the views that show nobody, and those that the run leaves out."""
    usable, warnings = with_training_views(capture)
    for sentence in warnings:
        _log.warning("%s", sentence)
    return without_training_views(usable, run.settings.covered)


class _Addition(NamedTuple):
    """Training beyond the budget: its seconds, and the seconds and the fraction of the schedule at
    which it begins."""

    seconds: float
    begun_s: float
    begun_fraction: float


@dataclass
class _Session:
    """A run that trains.

    strain_range  (F, 2, 6) `Avatar.strain_range`; with refined tracking that of the meshes of now
    elapsed_s     seconds of training so far, evaluation not counted
    losses        of the last global iterations
    began         the clock at which the run would have begun, had it never been interrupted
    speed         iterations per second since this process began to train
    tracking_gain TRACKING_GAIN, on which the next evaluation decides; NaN: nothing was left out
    interrupts    the first Ctrl-C
    addition      training beyond the budget, if it was asked for
    fitting_s     what is left of fitting unseen heads after a budget in seconds, at most
    measured      the avatar that was kept, once it was read
    """

    capture: Capture
    folder: Path
    run: Run
    report: Report
    trainer: Trainer
    evaluator: Evaluator
    strain_range: np.ndarray | None
    elapsed_s: float = 0.0
    losses: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT_LOSSES))
    began: float = 0.0
    speed: float = 0.0
    tracking_gain: float | None = None
    interrupts: list[int] = field(default_factory=list)
    addition: _Addition | None = None
    fitting_s: float = 0.0
    measured: Avatar | None = None

    def begin_addition(self, seconds: float) -> None:
        """Train so long from here on, whatever budget and goals the run began with."""
        begun_fraction = min(self._spent().fraction, START_FRACTION)
        self.addition = _Addition(seconds, self.elapsed_s, begun_fraction)
        evaluator = self.evaluator
        evaluator.settings = replace(evaluator.settings, target_psnr=None, stop_when_flat=False)
        evaluator.count = int(begun_fraction * EVALUATIONS)
        tracking = self.trainer.tracking
        if tracking is not None:  # unseen heads are fitted to the later avatar again
            tracking.rounds = min(tracking.rounds, 1)

    def complete(self) -> None:
        """Train until the budget is spent, a goal is reached or the report asks to stop."""
        if self.trainer.tracking is not None and self._without_training_views():
            self.fitting_s = TRACKING_TIME_FRACTION * (self.run.settings.seconds or 0.0)
        # meanwhile, the splats are shown as they begin
        self._report_progress("Compiling kernels", longer=1.0)
        precompile_kernels(self.run.device)
        self.trainer.prepare_hooks()
        lines = self.evaluator.lines
        self.began = perf_counter() - (lines[-1]["wall_s"] if lines else 0.0)
        if self._is_whole():
            self._write_what_is_missing()
            return
        with interrupt_requests() as self.interrupts:
            if self.run.continuation is not None and not lines:
                self._evaluate()  # the avatar before, which the others are compared with
            self._train_steps()
            if not self._is_trained():
                self._stop()
            elif self._evaluate_finally():
                self._report_progress("Measuring residuals")
                self._write_residuals()
        self._report_progress("Interrupted" if self.interrupts else "Trained")
        if self.interrupts:
            raise KeyboardInterrupt

    def _train_steps(self) -> None:
        """Make steps, evaluations and checkpoints until training is finished or is to stop."""
        trainer = self.trainer
        tracking = self.trainer.tracking
        saved = self.elapsed_s
        started = self.elapsed_s
        first = trainer.iteration
        interval_s = _asked_interval_s()
        with ExitStack() as stack:
            loader = stack.enter_context(self._loader())
            while self._refinement_is_due() or not self._spent().fraction >= 1:
                begin = perf_counter()
                # a run that was stopped in the middle of it has made the step before
                if not self._refinement_is_due():
                    view, image, mask, mesh = next(loader)
                    loss = trainer.step(view, image, self._spent().fraction, mask, mesh)
                    self.elapsed_s += perf_counter() - begin
                    if loss is not None:
                        self.losses.append(loss)
                if tracking is not None and self._refinement_is_due():
                    begin = perf_counter()
                    self._track_training_timesteps(tracking)
                    self.elapsed_s += perf_counter() - begin
                    if not tracking.rounds:
                        break
                    if self.run.settings.backdrop == "mesh":
                        # what was read ahead or is kept was cut by the meshes of before
                        loader.close()
                        loader = stack.enter_context(self._loader())
                if self.evaluator.is_due(self._spent()):
                    self._evaluate()
                    if self._is_finished():
                        break
                if self.elapsed_s - saved > (CHECKPOINT_S if interval_s is None else interval_s):
                    self._write_checkpoint()
                    saved = self.elapsed_s
                elapsed_s = max(self.elapsed_s - started, 1e-9)
                self.speed = (trainer.iteration - first) / elapsed_s
                if self._report_progress("Training") or self.interrupts:
                    break

    def _refinement_is_due(self) -> bool:
        """Whether the avatar is to track its head now, before anything else."""
        tracking = self.trainer.tracking
        fraction = self._spent().fraction
        return tracking is not None and not tracking.rounds and fraction >= TRACKING_START_FRACTION

    def _is_trained(self) -> bool:
        return self._is_finished() and not self._refinement_is_due()

    def _is_whole(self) -> bool:
        """Whether the run is trained and evaluated, its unseen heads included."""
        lines = self.evaluator.lines
        evaluated = bool(lines) and lines[-1]["iteration"] == self.trainer.iteration
        return self._is_trained() and evaluated and not self._unseen_timesteps()

    def _unseen_timesteps(self) -> list[int]:
        """Timesteps without training views that the avatar is still to track."""
        tracking = self.trainer.tracking
        if tracking is None or not tracking.has_moved or tracking.rounds != 1:
            return []
        return self._without_training_views()

    def _without_training_views(self) -> list[int]:
        every = views_by_timestep(self.capture.all_views)
        return sorted(every.keys() - views_by_timestep(self.capture.views["train"]).keys())

    def _stop(self) -> None:
        """Save the run for its resumption, and evaluate the avatar of now, which is kept meanwhile
        where it is better: what an unbroken run would not have done is undone by `_resume`."""
        self._write_checkpoint()
        lines = self.evaluator.lines
        if lines and lines[-1]["iteration"] == self.trainer.iteration:
            return
        self._record(self._measure(sets_aside=True))

    def _evaluate_finally(self) -> bool:
        """Evaluate what was trained, also with the heads of unseen timesteps fitted; False where
        the report stops the work meanwhile."""
        measured = self._measure(perceptual=True)
        fitted = self._fit_unseen_heads()
        if fitted is None:
            self._write_checkpoint()
        self._record({**measured, **(fitted or {})})
        if fitted is not None:
            self._write_checkpoint()
        return fitted is not None

    def _write_what_is_missing(self) -> None:
        """Write the missing files of a finished run that was resumed."""
        avatar, residuals = (self.folder / name for name in (AVATAR, folders.RESIDUALS))
        if not avatar.exists():
            text = "it is written anew from the checkpoint, the last state of training"
            _log.warning("%s was missing; %s", avatar, text)
            self._report_progress("Writing the missing avatar from the checkpoint")
            self._write_avatar()
            residuals.unlink(missing_ok=True)
        if not residuals.exists():
            self._report_progress("Measuring residuals")
            self._write_residuals()

    def _loader(self) -> ViewLoader:
        """The views to train from here on."""
        settings = self.run.settings
        capture = self.capture
        first = self.trainer.iteration
        if self.run.continuation is None:
            takes = [list[View]() for _ in range(1 + len(self.run.takes))]
            for view in capture.views["train"]:
                takes[self.run.take_at(view.timestep)].append(view)
            order = take_order(
                list(filter(None, takes)), settings.views_per_visit, settings.seed, first
            )
        else:
            region = self.trainer.strategy.region
            order = continued_order(self.run.continuation, capture, region, settings.seed, first)
        coarse, full = image_scales(settings, capture.views["train"])

        def scale(position: int) -> float:
            """Fraction of the captured size; by the clock, a few images ahead of it."""
            total = settings.iterations
            fraction = self._spent().fraction if total is None else (first + position) / total
            return coarse if fraction < settings.coarse_share else full

        tracking = self.trainer.tracking
        # refined meshes change halfway
        mesh = self.trainer.frames.mesh_unless_kept if tracking is None else None
        refined = capture if tracking is None else tracking.refined(capture)
        prepare = image_preparation(refined, settings)
        limits = DEFAULT_LIMITS._replace(readers=image_readers(self.run.device))
        return ViewLoader(order, scale, settings.background_levels, limits, prepare, mesh=mesh)

    def _track_training_timesteps(self, tracking: RefinedTracking) -> None:
        """Let the avatar track the training timesteps; undo it where views that are left out of the
        tracking gain nothing."""
        views = self.capture.views["train"]
        before = tracking.parameters
        timesteps = sorted({view.timestep for view in views})
        left_out = [
            view for view in self.capture.views.get("val", ()) if view.timestep in timesteps
        ]
        tracked = timesteps
        has_enough = len(timesteps) >= MIN_TIMESTEPS_TO_LEAVE_OUT
        if not left_out and has_enough and is_in_order(self.capture.root) is not False:
            middle = min(LEFT_OUT_INTERVAL, len(timesteps)) // 2
            unused = timesteps[middle:-1:LEFT_OUT_INTERVAL]  # each between two others
            left_out = [view for view in views if view.timestep in unused]
            tracked = [timestep for timestep in timesteps if timestep not in unused]
        left_out = evenly_spread(left_out, LEFT_OUT_VIEWS)
        error = self._squared_error(left_out)
        capture = replace(self.capture, views={"train": views})
        covered = {timestep for _, timestep in self.run.settings.covered}
        changed = sorted(covered.union(timesteps))
        if not self._track(self._avatar(), tracking, capture, tracked, changed):
            return
        self.trainer.frames.clear()
        self.strain_range = None
        tracking.rounds += 1
        self.tracking_gain = math.nan
        if not left_out:
            _log.warning("Tracking by the avatar is kept unchecked: %s", UNCHECKED)
            return
        gain = 10 * math.log10(error / self._squared_error(left_out))
        self.tracking_gain = round(gain, 3)
        if gain <= 0:
            tracking.parameters = before
            self.trainer.frames.clear()

    def _fit_unseen_heads(self) -> dict[str, float] | None:
        """Let the kept avatar track timesteps without training views, which changes no splat; its
        quality with heads fitted so, to the images that it is measured by. Empty where none is
        fitted; None when the report stops it."""
        tracking = self.trainer.tracking
        unseen = self._unseen_timesteps()
        if tracking is None or not unseen:
            return {}
        avatar = self.measured = read_avatar(self.folder / AVATAR)
        settings = self.run.settings
        kept = RefinedTracking(self.capture, settings.convention)
        kept.parameters = folders.read_tracking(self.folder, tracking.sequence)
        found = self._track(avatar, kept, self.capture, unseen, unseen)
        self.fitting_s = 0.0
        if found is None:
            return None
        tracking.take(found, unseen)
        self.trainer.frames.clear()
        tracking.rounds += 1
        folders.write_tracking(self.folder, kept.sequence, kept.parameters, kept.tracked)
        if not any(each.view.timestep in unseen for each in self.evaluator.views):
            return {}
        capture = kept.refined(self.capture)

        def render(view: View) -> np.ndarray:
            mesh = capture.mesh(view.timestep)
            return render_avatar(avatar, mesh, view.camera, avatar.background)

        quality = self.evaluator.measure(render, perceptual=True)
        return metrics.with_fitted_heads({}, quality.as_json())

    def _squared_error(self, views: Sequence[View]) -> float:
        """Mean over the views, of images as high as the avatar tracks in; never quite 0."""
        settings = self.run.settings
        fraction = self._spent().fraction
        errors = []
        prepare = image_preparation(self.capture, settings)
        for view in views:
            small, image = read_small(view, MAX_HEIGHT_PX, settings, prepare)
            drawn = self.trainer.render(small, fraction)
            errors.append(np.square(drawn - image.transpose(2, 0, 1) / 255).mean())
        return float(np.mean(errors)) + 1e-12 if errors else math.nan

    def _track(
        self,
        avatar: Avatar,
        tracking: RefinedTracking,
        capture: Capture,
        tracked: Sequence[int],
        changed: Sequence[int],
    ) -> AvatarTracking | None:
        """Track timesteps of a capture by the avatar; None when the report stops it. changed: the
        same and those between them, which change as their neighbors do."""

        def stops(done: int, total: int) -> bool:
            if seconds is not None and tracking is not self.trainer.tracking:
                self.fitting_s = seconds * (1 - done / total)
            is_stopped = self._report_progress(f"Tracking by the avatar: {done} of {total}")
            return is_stopped or bool(self.interrupts)

        settings = self.run.settings
        trained = TrainedAvatar(avatar, settings)
        capture = tracking.refined(capture)
        chosen = tracked_timesteps(settings, capture, tracked)
        seconds = None if settings.seconds is None else TRACKING_TIME_FRACTION * settings.seconds
        try:
            found = track_by_avatar(trained, capture, chosen, seconds, stops)
        except Cancelled:
            return None
        too_far = []
        for take in self.run.by_take(changed):  # no motion leads from one take to the next
            part = found.at(take)
            too_far += tracking.take(part, take) if part.timesteps else []
        if too_far:
            _log.warning("Tracking by the avatar: %s", not_moved(too_far))
        return found

    def _evaluate(self) -> None:
        """Evaluate, keep the avatar where that says so, and append a line of metrics."""
        self._record(self._measure())

    def _measure(self, perceptual: bool = False, sets_aside: bool = False) -> dict[str, float]:
        """Fields of a metrics line of the avatar of now, which is written where it is to be kept;
        sets_aside: after the one before was."""
        begin = perf_counter()
        fraction = min(1.0, self._spent().fraction)
        limits = self._strain_limits() if self.trainer.tracking is not None else None
        with self.trainer.frames.strain_within(limits):
            render = partial(self.trainer.render, progress=fraction)
            quality, is_kept = self.evaluator.evaluate(render, perceptual)
        self._require_folder()
        if is_kept:
            for name, moved in SET_ASIDE.items() if sets_aside else ():
                if (self.folder / name).exists():
                    os.replace(self.folder / name, self.folder / moved)
            self._write_avatar()
        return {**quality, "evaluation_s": round(perf_counter() - begin, 3)}

    def _record(self, measured: Mapping[str, float]) -> None:
        gain = self.tracking_gain
        line = {
            "iteration": self.trainer.iteration,
            "seconds": round(self.elapsed_s, 3),
            "splats": len(self.trainer),
            **({"loss": float(np.mean(self.losses))} if self.losses else {}),
            **measured,
            **({} if gain is None else {TRACKING_GAIN: gain}),
            "wall_s": round(perf_counter() - self.began, 3),
            "peak_memory_mb": metrics.peak_memory_mb(),
        }
        append_metrics(self.folder, self.evaluator.record(line, self._spent()))
        self.tracking_gain = None

    def _spent(self) -> Spent:
        settings = self.run.settings
        iterations = self.trainer.iteration
        begun_fraction = done_s = 0.0
        budget_s = settings.seconds
        if self.addition is not None:
            budget_s, done_s, begun_fraction = self.addition
        if budget_s is not None:
            done_s = self.elapsed_s - done_s
            fraction = begun_fraction + (1 - begun_fraction) * done_s / budget_s
            left_s = max(0.0, budget_s - done_s)
        else:
            fraction = iterations / (settings.iterations or 1)
            left_s = max(0.0, self.elapsed_s * (1 / fraction - 1)) if fraction > 0 else math.nan
        return Spent(fraction, self.elapsed_s, iterations, left_s)

    def _is_finished(self) -> bool:
        return self.evaluator.is_finished(self._spent())

    def _report_progress(self, stage: str, **more: float) -> bool:
        """Report how far the run is, with more figures; returns whether to stop."""
        spent = self._spent()
        evaluator = self.evaluator
        last = [{}, *self.evaluator.lines][-1]
        figures = {
            "iteration": spent.iterations,
            "per_second": self.speed,
            # and the last evaluation and the residuals
            "left_s": spent.left_s + self.fitting_s + 2 * last.get("evaluation_s", 0.0),
            "loss": np.mean(self.losses) if self.losses else None,
            "psnr": last.get("psnr"),
            "psnr_unmatched": last.get(UNMATCHED),
            "splats": len(self.trainer),
            **self._gain(),
            **more,
        }

        def known() -> dict[str, float]:
            values = {**figures, "memory_mb": metrics.peak_memory_mb()}
            return {name: float(value) for name, value in values.items() if value is not None}

        def preview(path: Path) -> None:
            # training continues without one, and reports a full disk itself
            with suppress(StgaError):
                write_avatar(path, self._avatar())

        fraction = min(1.0, spent.fraction)
        detail = evaluator.forecast_text
        lines = tuple(evaluator.lines)
        return self.report(Progress(fraction, stage, detail, known, preview, metrics=lines))

    def _gain(self) -> dict[str, float]:
        """Accuracy of the region of a refinement before it, and now."""
        lines = self.evaluator.lines
        known = [line[REGION_PSNR] for line in lines if REGION_PSNR in line]
        return {} if len(known) < 2 else {"before_db": known[0], "after_db": known[-1]}

    def _avatar(self) -> Avatar:
        return self.trainer.avatar(self.run.principal_point, self._strain_limits())

    def _strain_limits(self) -> np.ndarray | None:
        """`strain_range`, measured anew where refined tracking has moved the training timesteps'
        meshes."""
        if self.strain_range is None and self.run.settings.follows_strain:
            mesh = self.trainer.frames.mesh
            self.strain_range = checkpoints.trained_strain_range(self.capture, mesh, None)
        return self.strain_range

    def _require_folder(self) -> None:
        """Raise StgaError where the folder was moved: writing would make it anew."""
        folder = self.folder
        if not folders.has_run(folder) or folders.read_run(folder).identity != self.run.identity:
            raise StgaError(
                f"{folder}: was moved or deleted while its run trained; resume the run from "
                "its checkpoint, in the folder where it is now"
            )

    def _write_avatar(self) -> None:
        write_avatar(self.folder / AVATAR, self._avatar())
        found = self.trainer.tracking
        if found is not None:
            folders.write_tracking(self.folder, found.sequence, found.parameters, found.tracked)

    def _write_checkpoint(self) -> None:
        trainer = self.trainer
        tracking = self.trainer.tracking
        evaluator = self.evaluator
        self._require_folder()
        checkpoint = checkpoints.Checkpoint(
            state=trainer.state,
            iteration=trainer.iteration,
            visit=trainer.visit,
            last_timestep=trainer.last_timestep,
            initial_count=trainer.initial_count,
            elapsed_s=self.elapsed_s,
            evaluations=evaluator.count,
            losses=tuple(self.losses),
            lines=len(evaluator.lines),
            tracking_gain=self.tracking_gain,
            tracking=None if tracking is None else tracking.parameters,
            rounds=0 if tracking is None else tracking.rounds,
            identity=self.run.digest,
        )
        checkpoints.write_checkpoint(self.folder, checkpoint)

    def _write_residuals(self) -> None:
        """Measure the written avatar's error by triangle, over a few views of all frames."""
        capture = self.capture
        settings = self.run.settings
        if self.trainer.tracking is not None:
            capture = folders.with_refined_tracking(capture, self.folder)
        views = [view for split in ("train", "val") for view in self.capture.views.get(split, ())]
        chosen = evenly_spread(views, RESIDUAL_VIEWS)
        prepare = image_preparation(capture, settings)
        avatar = self.measured = read_avatar(self.folder / AVATAR)
        residuals = triangle_residuals(avatar, capture, chosen, prepare, RESIDUAL_SCALE)
        folders.write_residuals(self.folder, residuals.mean())


def _begin(
    capture: Capture, folder: Path, run: Run, selection: Selection | None, report: Report
) -> _Session:
    """Start a new run: select triangles, by the rule or as given, place splats, write its files."""
    report(Progress(stage="Placing splats"))
    settings = run.settings
    continuation = run.continuation
    state = None
    if selection is None:
        selective = settings.strategy == "selective"
        selection = select_capture(capture, settings.selection) if selective else {}
    if continuation is not None:
        state = starting_state(continuation, settings, len(capture.faces))
        checkpoints.check_fits(folder, capture, settings, state)
    # of a run whose run.json was removed
    for stale in (
        TRACKING,
        CHECKPOINT,
        METRICS,
        *SET_ASIDE.values(),
        checkpoints.STRAIN_RANGE,
        folders.WORLD_FILE,
        folders.RESIDUALS,
    ):
        (folder / stale).unlink(missing_ok=True)
    session = _session(capture, folder, run, selection, state, report)
    if continuation is not None and (continuation.parent / TRACKING).exists():
        with replacing(folder / TRACKING) as partial_file:
            copyfile(continuation.parent / TRACKING, partial_file)
    checkpoints.write_selection(folder, selection, run.digest)
    folders.write_run(folder, run)
    return session


def _resume(capture: Capture, folder: Path, run: Run, report: Report) -> _Session:
    """Continue from the folder's checkpoint. Raises StgaError where it does not fit."""
    report(Progress(stage="Reading the checkpoint"))
    found = checkpoints.read_checkpoint(folder)
    if found.identity != run.digest:
        raise StgaError(f"{folder / CHECKPOINT}: {checkpoints.OTHER_RUN}")
    selection = checkpoints.read_selection(folder, len(capture.faces), run.digest)
    checkpoints.check_fits(folder, capture, run.settings, found.state)
    session = _session(capture, folder, run, selection, found.state, report)
    trainer = session.trainer
    tracking = session.trainer.tracking
    evaluator = session.evaluator
    refined = found.tracking
    wanted = None
    if tracking is not None:
        wanted = tracking.parameters.shape
    if wanted != (None if refined is None else refined.shape):
        raise StgaError(
            f"{folder}: its checkpoint's refined tracking does not fit the capture or the settings"
        )
    trainer.iteration = found.iteration
    trainer.visit = found.visit
    trainer.last_timestep = found.last_timestep
    trainer.initial_count = found.initial_count
    if tracking is not None and refined is not None:
        tracking.parameters = refined
        tracking.rounds = found.rounds
    session.elapsed_s = found.elapsed_s
    session.losses.extend(found.losses)
    session.tracking_gain = found.tracking_gain
    evaluator.lines = cut_metrics(folder, found.lines)
    evaluator.count = found.evaluations
    for name, moved in SET_ASIDE.items():
        if (folder / moved).exists():
            os.replace(folder / moved, folder / name)
    if not (folder / AVATAR).exists():
        evaluator.keeps_latest = True  # those before are lost
    folders.write_run(folder, run)  # capture, model and device may be others now
    return session


def _session(
    capture: Capture,
    folder: Path,
    run: Run,
    selection: Selection,
    state: TrainState | None,
    report: Report,
) -> _Session:
    settings = run.settings
    if settings.follows_strain and not settings.tracking:
        report(Progress(stage="Measuring strain"))
    strain_range = checkpoints.strain_range_of(folder, capture, run)
    trainer = Trainer(capture, settings, selection, Start(state, strain_range), run.device)
    views = grouped_evaluation_views(run, capture, trainer.strategy.region)
    rows = settings.exposure  # where images are corrected for it
    exposure = metrics.known_exposure(rows, capture.views["train"]) if rows else None
    evaluator = Evaluator(settings, views, exposure=exposure)
    return _Session(capture, folder, run, report, trainer, evaluator, strain_range)


def _asked_interval_s() -> float | None:
    """Seconds between checkpoints by the environment variable; None without it."""
    text = os.environ.get(CHECKPOINT_VARIABLE, "")
    with suppress(ValueError):
        if not text or 0 <= float(text) < math.inf:
            return float(text) if text else None
    raise StgaError(
        f"{CHECKPOINT_VARIABLE}: expected seconds between checkpoints, got {shorten(text)}"
    )


@contextmanager
def interrupt_requests() -> Iterator[list[int]]:
    """A list that receives the first Ctrl-C; the second one raises KeyboardInterrupt. Without
    effect off the main thread and in Blender, which handles Ctrl-C itself."""
    requests: list[int] = []

    def request(number: int, _frame: object) -> None:
        if requests:
            raise KeyboardInterrupt
        requests.append(number)

    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield requests
        return
    signal.signal(signal.SIGINT, request)
    try:
        yield requests
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
