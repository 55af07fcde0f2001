"""Training of a run in its folder: begun or resumed, then steps, evaluations and checkpoints in
turn."""

import logging
import math
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from shutil import copyfile
from time import perf_counter
from typing import Any

import numpy as np

from ...avatar.file import Avatar, read_avatar, write_avatar
from ...avatar.splats import ADDED
from ...capture.loader import ViewLoader
from ...capture.model import Capture, ViewExposure, evenly_spread
from ...errors import DeviceError, StgaError, shorten
from ...files import replacing
from ...flame.sequence import SHIFT_SIZE
from ...progress import Cancelled, Progress, Report, ignore
from ...schema import to_json
from ...selection import select_capture
from ..evaluate import lpips
from ..evaluate.evaluation_views import (
    EvaluationView,
    choose_evaluation_views,
    read_evaluation_view,
)
from ..evaluate.evaluator import Evaluation, Evaluator, Spent
from ..evaluate.match_exposure import known_exposure
from ..evaluate.metrics import peak_memory_mb
from ..evaluate.residuals import RESIDUAL_SCALE, triangle_residuals
from ..optimize.avatar_tracking import track_by_avatar
from ..optimize.image_preparation import image_preparation
from ..optimize.precompile import precompile_kernels
from ..optimize.state import TrainState
from ..optimize.trainer import Trainer
from ..schedule import image_scale, view_order
from ..settings import TrainingSettings
from .checkpoint import (
    OTHER_RUN,
    Checkpoint,
    read_checkpoint,
    read_selection,
    write_checkpoint,
    write_selection,
)
from .continuation import continued_evaluation_views, continued_order, starting_state
from .folder import (
    AVATAR,
    CHECKPOINT,
    RUN,
    SELECTION,
    TRACKING,
    WORLD_FILE,
    Run,
    check_identity,
    has_run,
    locked,
    read_run,
    with_refined_tracking,
    write_residuals,
    write_run,
    write_tracking,
)  # fmt: skip
from .metrics_log import METRICS, append_metrics, cut_metrics, read_metrics
from .strain_range import STRAIN_RANGE, require_color_range, strain_range_of, trained_strain_range

_log = logging.getLogger(__name__)
CHECKPOINT_S = 30.0
"""Seconds of training between checkpoints: what a crash may cost."""
CHECKPOINT_VARIABLE = "STGA_CHECKPOINT_S"
"""Environment variable that replaces it, for machines that are taken away often."""
TRACKING_START_SHARE, TRACKING_TIME_SHARE = 0.5, 0.2
"""Of the budget, after which the avatar tracks its head; and of a budget in seconds, what that may
take."""
RECENT_LOSSES = 100
"""Global iterations that the loss in messages and metrics is the mean of."""
RESIDUAL_VIEWS = 24
"""Views in which the residuals of a finished run are measured."""


@dataclass
class Session:
    """A run between two of its steps.

    strain_range  (F, 2, 3) `Avatar.strain_range`; with refined tracking that of the last evaluation
    elapsed_s     seconds of training so far, evaluation not counted
    losses        of the last global iterations
    """

    capture: Capture
    folder: Path
    run: Run
    trainer: Trainer
    strain_range: np.ndarray | None
    elapsed_s: float = 0.0
    losses: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT_LOSSES))

    @property
    def settings(self) -> TrainingSettings:
        return self.run.settings

    @property
    def loss(self) -> float | None:
        """Mean of the recent losses; None before there is one."""
        return float(np.mean(self.losses)) if self.losses else None

    def spent(self) -> Spent:
        iterations = self.trainer.iteration
        if self.settings.seconds is not None:
            return Spent(self.elapsed_s / self.settings.seconds, self.elapsed_s, iterations)
        return Spent(iterations / (self.settings.iterations or 1), self.elapsed_s, iterations)

    def loader(self) -> ViewLoader:
        """The views to train from here on."""
        settings, first = self.settings, self.trainer.iteration
        red, green, blue = (round(255 * c) for c in settings.background)
        if self.run.continuation is None:
            order = view_order(
                self.capture.views["train"], settings.views_per_visit, settings.seed, first
            )
        else:
            region = _refined_region(self.run, self.trainer)
            order = continued_order(
                self.run.continuation, self.capture, region, settings.seed, first
            )
        prepare = image_preparation(self.capture, settings)
        # refined meshes change with every step
        mesh = self.capture.mesh if self.trainer.tracking is None else None
        return ViewLoader(
            order,
            lambda position: self._scale(first + position),
            (red, green, blue),
            prepare=prepare,
            mesh=mesh,
        )

    def step(self, loader: ViewLoader, clock: Callable[[], float]) -> None:
        """Train the loader's next view."""
        begin = clock()
        view, image, mask, mesh = next(loader)
        loss = self.trainer.step(view, image, self.spent().share, mask, mesh)
        self.elapsed_s += clock() - begin
        if loss is not None:
            self.losses.append(loss)

    @property
    def tracking_is_due(self) -> bool:
        """Whether the avatar is to track the training's timesteps now."""
        tracking = self.trainer.tracking
        return (
            tracking is not None
            and not tracking.rounds
            and self.spent().share >= TRACKING_START_SHARE
        )

    def track(self, clock: Callable[[], float], report: Callable[[int, int], bool]) -> bool:
        """Track the training's timesteps by the avatar; returns False where the report said to
        stop."""
        tracking, begin, seconds = self.trainer.tracking, clock(), self.settings.seconds
        assert tracking is not None
        done = self._tracked(
            sorted({view.timestep for view in self.capture.views["train"]}),
            None if seconds is None else TRACKING_TIME_SHARE * seconds,
            report,
        )
        tracking.rounds += done
        self.elapsed_s += clock() - begin
        return done

    def track_unseen(self, report: Callable[[int, int], bool]) -> None:
        """Track the timesteps of other splits by the avatar, whose splats they do not change."""
        tracking, seconds = self.trainer.tracking, self.settings.seconds
        views = self.capture.views
        seen = {view.timestep for view in views["train"]}
        unseen = sorted({view.timestep for own in views.values() for view in own} - seen)
        if tracking is not None and tracking.rounds == 1 and unseen:
            limit = None if seconds is None else TRACKING_TIME_SHARE * seconds
            tracking.rounds += self._tracked(unseen, limit, report)

    def _tracked(
        self, timesteps: list[int], seconds: float | None, report: Callable[[int, int], bool]
    ) -> bool:
        tracking = self.trainer.tracking
        assert tracking is not None
        try:
            found = track_by_avatar(
                self.avatar(),
                self.settings,
                tracking.refined(self.capture),
                timesteps,
                seconds,
                report,
            )
        except Cancelled:
            return False
        tracking.take(found, timesteps)
        self.trainer.frames.clear()
        return True

    def evaluate(self, evaluator: Evaluator, perceptual: bool) -> Evaluation:
        """Evaluate the avatar as it would be written now."""
        share, refines = min(1.0, self.spent().share), self.trainer.tracking is not None
        if refines:
            self._measure_refined_strain()
        with self.trainer.frames.strain_within(self.strain_range if refines else None):
            return evaluator.evaluate(lambda view: self.trainer.render(view, share), perceptual)

    def avatar(self) -> Avatar:
        if self.strain_range is None:
            self._measure_refined_strain()
        state = self.trainer.state
        return Avatar(
            state.averaged(),
            self.settings.convention,
            self.capture.neutral.astype(np.float32),
            self.capture.faces,
            to_json(self.settings),
            dict(self.capture.regions),
            self.settings.background,
            self.settings.antialiased,
            self.run.principal_point,
            self.strain_range,
            {name: offset.average.copy() for name, offset in state.driven_offsets.items()},
        )

    def figures(self) -> dict[str, Any]:
        """Fields of a metrics line that are known without an evaluation."""
        figures = {
            "iteration": self.trainer.iteration,
            "seconds": round(self.elapsed_s, 3),
            "splats": len(self.trainer),
        }
        return figures if self.loss is None else {**figures, "loss": self.loss}

    def require_folder(self) -> None:
        """Raise StgaError where the run is no longer in its folder, which writing would make
        anew."""
        if (self.folder / RUN).exists() and read_run(self.folder).identity == self.run.identity:
            return
        raise StgaError(
            f"{self.folder}: was moved or deleted while its run trained; resume the run from its checkpoint, "
            "in the folder where it is now"
        )

    def write_avatar(self) -> None:
        write_avatar(self.folder / AVATAR, self.avatar())
        refined = self.trainer.tracking
        if refined is not None:
            write_tracking(self.folder, refined.sequence, refined.parameters, refined.tracked)

    def write_checkpoint(self, evaluator: Evaluator) -> None:
        trainer = self.trainer
        assert self.run.identity is not None
        self.require_folder()
        checkpoint = Checkpoint(
            trainer.state, trainer.iteration, trainer.visit, trainer.last_timestep, trainer.initial_count,
            self.elapsed_s, evaluator.best_difference, evaluator.count, list(self.losses),
            None if trainer.tracking is None else trainer.tracking.parameters,
            0 if trainer.tracking is None else trainer.tracking.rounds, self.run.identity.digest,
        )  # fmt: skip
        write_checkpoint(self.folder, checkpoint)

    def write_residuals(self) -> None:
        """Measure the error of the written avatar on each triangle, over a few views of all frames
        and cameras."""
        views = [view for split in ("train", "val") for view in self.capture.views.get(split, ())]
        refined = self.trainer.tracking is not None
        capture = with_refined_tracking(self.capture, self.folder) if refined else self.capture
        residuals = triangle_residuals(
            read_avatar(self.folder / AVATAR), capture, evenly_spread(views, RESIDUAL_VIEWS),
            image_preparation(capture, self.settings), RESIDUAL_SCALE,
        )  # fmt: skip
        write_residuals(self.folder, residuals.mean())

    def _scale(self, iteration: int) -> float:
        """Size of an iteration's image, as a share of the captured one; by the clock, a few images
        ahead of it."""
        total = self.settings.iterations
        return image_scale(
            self.settings, self.spent().share if total is None else iteration / total
        )

    def _measure_refined_strain(self) -> None:
        """Measure the strain of all training timesteps where refined tracking has moved their
        meshes."""
        if self.settings.follows_strain:
            self.strain_range = trained_strain_range(self.capture, self.trainer.frames.mesh, None)


def begin_session(
    capture: Capture,
    folder: Path,
    run: Run,
    selection: Mapping[int, np.ndarray] | None,
    report: Report,
) -> tuple[Session, Evaluator]:
    """Start a new run: select triangles, place splats, and write the run's files.

    selection: timestep -> (F,) bool to train; None: by the rule.
    """
    report(Progress(stage="Placing splats"))
    settings, continuation, state = run.settings, run.continuation, None
    if selection is None:
        selection = (
            select_capture(capture, settings.selection) if settings.strategy == "selective" else {}
        )
    if continuation is not None:
        state = starting_state(continuation, settings, len(capture.faces))
        _check_state(folder, capture, settings, state)
    # of a run whose run.json was removed
    for stale in (TRACKING, CHECKPOINT, METRICS, STRAIN_RANGE, WORLD_FILE):
        (folder / stale).unlink(missing_ok=True)
    strain_range = _strain_range(folder, capture, run, report)
    trainer = Trainer(capture, settings, selection, state, run.device, strain_range)
    if continuation is not None and (continuation.parent / TRACKING).exists():
        with replacing(folder / TRACKING) as partial:
            copyfile(continuation.parent / TRACKING, partial)
    session = Session(capture, folder, run, trainer, strain_range)
    views, exposure = _evaluation_views(capture, run, trainer), _exposure(capture, run)
    evaluator = Evaluator(settings, views, continuation is not None, exposure)
    assert run.identity is not None
    write_selection(folder, selection, run.identity.digest)
    write_run(folder, run)
    return session, evaluator


def resume_session(
    capture: Capture, folder: Path, run: Run, report: Report
) -> tuple[Session, Evaluator]:
    """Continue from the folder's checkpoint. Raises StgaError where it does not fit the capture or
    the settings."""
    report(Progress(stage="Reading the checkpoint"))
    assert run.identity is not None
    checkpoint = read_checkpoint(folder)
    if checkpoint.identity != run.identity.digest:
        raise StgaError(f"{folder / CHECKPOINT}: {OTHER_RUN}")
    selection = read_selection(folder, len(capture.faces), run.identity.digest)
    _check_state(folder, capture, run.settings, checkpoint.state)
    strain_range = _strain_range(folder, capture, run, report)
    trainer = Trainer(capture, run.settings, selection, checkpoint.state, run.device, strain_range)
    _restore(folder, trainer, checkpoint)
    session = Session(capture, folder, run, trainer, strain_range, checkpoint.elapsed_s)
    session.losses.extend(checkpoint.losses)
    cut_metrics(folder, checkpoint.iteration)
    evaluator = Evaluator(
        run.settings, _evaluation_views(capture, run, trainer), run.continuation is not None, _exposure(capture, run),
        read_metrics(folder), checkpoint.evaluations, checkpoint.best_difference,
    )  # fmt: skip
    if not (folder / AVATAR).exists():
        evaluator.best_difference = math.inf  # so that the next evaluation writes one
    elif not evaluator.is_finished(session.spent()):
        require_color_range(folder / AVATAR, read_avatar(folder / AVATAR))
    write_run(folder, run)  # capture, model and device may be others now
    return session, evaluator


def _restore(folder: Path, trainer: Trainer, checkpoint: Checkpoint) -> None:
    here, there = trainer.tracking, checkpoint.tracking
    if here is not None and there is not None and there.shape == here.tracked.shape:
        there = np.pad(there, ((0, 0), (0, SHIFT_SIZE)))  # of a version that shifted no torso
    wanted = None if here is None else here.parameters.shape
    if wanted != (None if there is None else there.shape):
        raise StgaError(
            f"{folder}: its checkpoint's refined tracking does not fit the capture or the settings"
        )
    trainer.restore(
        checkpoint.iteration, checkpoint.visit, checkpoint.last_timestep, checkpoint.initial_count
    )
    if here is not None and there is not None:
        here.parameters, here.rounds = there, checkpoint.rounds


def _strain_range(folder: Path, capture: Capture, run: Run, report: Report) -> np.ndarray | None:
    if run.settings.follows_strain:
        report(Progress(stage="Measuring strain"))
    return strain_range_of(folder, capture, run)


def _evaluation_views(capture: Capture, run: Run, trainer: Trainer) -> list[EvaluationView]:
    if run.continuation is not None:
        return continued_evaluation_views(run, capture, _refined_region(run, trainer))
    background, backdrop = run.settings.background, run.settings.backdrop
    return [
        read_evaluation_view(capture, view, background, backdrop)
        for view in choose_evaluation_views(capture)
    ]


def _exposure(capture: Capture, run: Run) -> ViewExposure | None:
    """`known_exposure` where images are corrected for it."""
    rows = run.settings.exposure
    return known_exposure(rows, capture.views["train"]) if rows else None


def _refined_region(run: Run, trainer: Trainer) -> np.ndarray | None:
    return trainer.strategy.region if run.settings.strategy == "refine" else None


def _check_state(
    folder: Path, capture: Capture, settings: TrainingSettings, state: TrainState
) -> None:
    """Raise StgaError where the checkpoint's splats do not fit the mesh or the settings."""
    face, splats, faces = state.face, state.splats(), len(capture.faces)
    if len(face) and not 0 <= int(face.min()) <= int(face.max()) < faces:
        raise StgaError(
            f"{folder}: its splats refer to triangles that {capture.root} does not have"
        )
    if splats.sh_degree != settings.sh_degree:
        found = splats.sh_degree
        raise StgaError(
            f"{folder}: its splats have SH degree {found}, run.json says {settings.sh_degree}"
        )
    for name in {name for name in ADDED if getattr(splats, name).shape[1]} ^ set(settings.added):
        raise StgaError(f"{folder}: its splats and run.json disagree on {name}")
    for name in state.driven_offsets.keys() ^ set(settings.driven_offsets):
        raise StgaError(
            f"{folder}: its checkpoint and run.json disagree on the driven offset {name}"
        )
    for name, offset in state.driven_offsets.items():
        found = len(offset.steps)
        if found != faces:
            raise StgaError(
                f"{folder}: its {name} is of {found} triangles, {capture.root} has {faces}"
            )


# Training


def train(
    capture: Capture,
    out: Path,
    run: Run,
    selection: Mapping[int, np.ndarray] | None = None,
    resume: bool = False,
    report: Report = ignore,
    falls_back: bool = False,
) -> Path:
    """Train a capture into the folder `out` and return the path of the avatar file.

    selection: timestep -> (F,) bool to use instead of the rule. With `resume`, continues from the
    folder's checkpoint to the parameters that an unbroken run would have reached (same seed, number
    of threads and device).
    falls_back: where a GPU fails, continue from the last checkpoint on the CPU.
    Raises StgaError where the capture has nothing to train on, the folder is in use, is the
    capture's or holds another run or one that cannot be continued (`require_color_range`), or
    STGA_LPIPS names a file without its weights. A first Ctrl-C raises KeyboardInterrupt when avatar
    and checkpoint are saved, a second one at once.
    """
    try:
        return _train(capture, out, run, selection, resume, report)
    except DeviceError as error:
        if not falls_back:
            raise
        _log.warning("%s; continuing on the CPU from the last checkpoint", error.cause)
    # Outside the handler: the error's traceback would keep the failed loop and its buffers alive.
    report(Progress(stage="Continuing on the CPU"))
    return _train(capture, out, replace(run, device="cpu"), selection, True, report)


def _train(
    capture: Capture,
    out: Path,
    run: Run,
    selection: Mapping[int, np.ndarray] | None,
    resume: bool,
    report: Report,
) -> Path:
    """`train` on the device of the run."""
    lpips.load_network()  # read now, because it is needed only when everything is trained
    if not capture.views.get("train"):
        raise StgaError(f"{capture.root}: has no training views, so there is nothing to train on")
    if run.settings.target_psnr is not None and not capture.views.get("val"):
        raise StgaError(
            f"--target-psnr: {capture.root} has no held-out views (split 'val') to measure it on"
        )
    if out.resolve() == capture.root:
        raise StgaError(f"{out}: is the folder of the capture; train into another one")
    with locked(out):
        exists = has_run(out)
        if exists and not resume:
            raise StgaError(f"{out}: already holds a run; resume it, or choose another folder")
        has_begun = exists and read_run(out).identity is not None
        identity = check_identity(out, run, capture)
        run = replace(run, identity=identity)
        if has_begun and (out / CHECKPOINT).exists():
            session, evaluator = resume_session(capture, out, run, report)
        else:
            if has_begun and selection is None and (out / SELECTION).exists():
                selection = read_selection(out, len(capture.faces), identity.digest)
            session, evaluator = begin_session(capture, out, run, selection, report)
        _Loop(session, evaluator, report).work()
    return out / AVATAR


def _asked_interval_s() -> float | None:
    """Seconds between checkpoints by the environment variable; None without it. Raises StgaError
    for no such number."""
    text = os.environ.get(CHECKPOINT_VARIABLE, "")
    if not text:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < math.inf:
        raise StgaError(
            f"{CHECKPOINT_VARIABLE}: expected seconds between checkpoints, got {shorten(text)}"
        )
    return seconds


@dataclass
class _Loop:
    """Steps, evaluations and checkpoints of a session in turn.

    began  the clock at which the run would have begun, had it never been interrupted
    speed  iterations per second since this process began to train
    """

    session: Session
    evaluator: Evaluator
    report: Report
    began: float = 0.0
    speed: float = 0.0

    def work(self) -> None:
        """Train until the budget is spent, a goal of the settings is reached or the report asks to
        stop."""
        # meanwhile, the splats are shown as they begin
        self.report(self._progress("Compiling kernels"))
        precompile_kernels(self.session.run.device)
        self.began = perf_counter() - (
            self.evaluator.lines[-1]["wall_s"] if self.evaluator.lines else 0.0
        )
        if self._is_finished():  # a finished run was resumed
            self._restore_avatar()
            return
        with interrupt_requests() as interrupts:
            if self.session.run.continuation is not None and not self.evaluator.lines:
                self._evaluate()  # the avatar before, which the others are compared with
            self._train(interrupts)
            if self._is_finished():
                self.session.track_unseen(self._tracks(interrupts))
            # LPIPS takes long, so a run that is stopped goes without
            self._evaluate(perceptual=self._is_finished())
            self.session.write_checkpoint(self.evaluator)
            if self._is_finished():
                self.report(self._progress("Measuring residuals"))
                self.session.write_residuals()
        self.report(self._progress("Interrupted" if interrupts else "Finished"))
        if interrupts:
            raise KeyboardInterrupt

    def _restore_avatar(self) -> None:
        """Write a finished run's avatar where it is missing."""
        path = self.session.folder / AVATAR
        if path.exists():
            return
        _log.warning(
            "%s was missing; it is written anew from the checkpoint, the last state of training",
            path,
        )
        self.report(self._progress("Writing the missing avatar from the checkpoint"))
        self.session.write_avatar()
        self.session.write_residuals()

    def _train(self, interrupts: list[int]) -> None:
        session = self.session
        saved, started, first = session.elapsed_s, session.elapsed_s, session.trainer.iteration
        asked_s = _asked_interval_s()
        with session.loader() as loader:
            while not session.spent().share >= 1:
                session.step(loader, perf_counter)
                if session.tracking_is_due and not session.track(
                    perf_counter, self._tracks(interrupts)
                ):
                    break
                if self.evaluator.is_due(session.spent()):
                    self._evaluate()
                    if self._is_finished():
                        break
                if session.elapsed_s - saved > (CHECKPOINT_S if asked_s is None else asked_s):
                    session.write_checkpoint(self.evaluator)
                    saved = session.elapsed_s
                self.speed = (session.trainer.iteration - first) / max(
                    session.elapsed_s - started, 1e-9
                )
                if self.report(self._progress("Training")) or interrupts:
                    break

    def _tracks(self, interrupts: list[int]) -> Callable[[int, int], bool]:
        """What tracking by the avatar reports to."""
        return lambda done, total: (
            self.report(self._progress(f"Tracking by the avatar: {done} of {total}"))
            or bool(interrupts)
        )

    def _evaluate(self, perceptual: bool = False) -> None:
        """Evaluate, keep the avatar where that says so, and append a line of metrics."""
        begin, session = perf_counter(), self.session
        evaluation = session.evaluate(self.evaluator, perceptual)
        session.require_folder()
        if evaluation.is_kept:
            session.write_avatar()
        now = perf_counter()
        line = {
            **session.figures(),
            **evaluation.quality,
            "evaluation_s": round(now - begin, 3),
            "wall_s": round(now - self.began, 3),
            "peak_memory_mb": peak_memory_mb(),
        }
        append_metrics(session.folder, self.evaluator.record(evaluation, line, session.spent()))

    def _is_finished(self) -> bool:
        return self.evaluator.is_finished(self.session.spent())

    def _progress(self, stage: str) -> Progress:
        session, spent, evaluator = self.session, self.session.spent(), self.evaluator
        figures = {
            "iteration": spent.iterations, "per_second": self.speed, "left_s": spent.left_s, "loss": session.loss,
            "psnr": evaluator.psnr, "psnr_unmatched": evaluator.psnr_unmatched, "splats": len(session.trainer),
        }  # fmt: skip

        def known() -> dict[str, float]:
            values = {**figures, "memory_mb": peak_memory_mb()}
            return {name: float(value) for name, value in values.items() if value is not None}

        def preview(path: Path) -> None:
            # training continues without one, and reports a full disk itself
            with suppress(StgaError):
                write_avatar(path, session.avatar())

        return Progress(min(1.0, spent.share), stage, evaluator.forecast_text, known, preview)


@contextmanager
def interrupt_requests() -> Iterator[list[int]]:
    """A list that receives the first Ctrl-C; the second one raises KeyboardInterrupt.

    Without effect off the main thread and in Blender, which handles Ctrl-C itself.
    """
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
