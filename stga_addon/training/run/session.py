"""Training of a run in its folder: begun or resumed, then steps, evaluations and checkpoints in
turn."""

import logging
import math
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from shutil import copyfile
from time import perf_counter

import numpy as np

from ...avatar.file import Avatar, read_avatar, write_avatar
from ...avatar.splats import ADDED
from ...capture.loader import ViewLoader
from ...capture.model import Capture, evenly_spread
from ...errors import DeviceError, StgaError, shorten
from ...files import replacing
from ...flame.sequence import SHIFT_SIZE
from ...progress import Cancelled, Progress, Report, ignore
from ...schema import to_json
from ...selection import select_capture
from ..evaluate import lpips
from ..evaluate.evaluator import Evaluator, Spent
from ..evaluate.forecast import UNMATCHED
from ..evaluate.metrics import (
    choose_evaluation_views,
    known_exposure,
    peak_memory_mb,
    read_evaluation_view,
)
from ..evaluate.residuals import RESIDUAL_SCALE, triangle_residuals
from ..optimize.avatar_tracking import RefinedTracking, track_by_avatar
from ..optimize.image_preparation import image_preparation
from ..optimize.precompile import precompile_kernels
from ..optimize.state import TrainState
from ..optimize.trainer import Trainer
from ..schedule import image_scales, view_order
from ..settings import TrainingSettings
from .checkpoint import (
    OTHER_RUN,
    STRAIN_RANGE,
    Checkpoint,
    read_checkpoint,
    read_selection,
    require_color_range,
    strain_range_of,
    trained_strain_range,
    write_checkpoint,
    write_selection,
)
from .continuation import continued_evaluation_views, continued_order, starting_state
from .folder import (
    AVATAR,
    CHECKPOINT,
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
        text = f"{capture.root} has no held-out views (split 'val') to measure it on"
        raise StgaError(f"--target-psnr: {text}")
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
            session = _resume(capture, out, run, report)
        else:
            if has_begun and selection is None and (out / SELECTION).exists():
                selection = read_selection(out, len(capture.faces), identity.digest)
            session = _begin(capture, out, run, selection, report)
        session.work()
    return out / AVATAR


@dataclass
class _Session:
    """A run that trains.

    strain_range  (F, 2, 3) `Avatar.strain_range`; with refined tracking that of the last evaluation
    elapsed_s     seconds of training so far, evaluation not counted
    losses        of the last global iterations
    began         the clock at which the run would have begun, had it never been interrupted
    speed         iterations per second since this process began to train
    interrupts    the first Ctrl-C
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
    interrupts: list[int] = field(default_factory=list)

    def work(self) -> None:
        """Train until the budget is spent, a goal is reached or the report asks to stop."""
        # meanwhile, the splats are shown as they begin
        self._tell("Compiling kernels")
        precompile_kernels(self.run.device)
        lines, path = self.evaluator.lines, self.folder / AVATAR
        self.began = perf_counter() - (lines[-1]["wall_s"] if lines else 0.0)
        if self._is_finished():  # a finished run was resumed
            if not path.exists():
                text = "it is written anew from the checkpoint, the last state of training"
                _log.warning("%s was missing; %s", path, text)
                self._tell("Writing the missing avatar from the checkpoint")
                self._write_avatar()
                self._write_residuals()
            return
        with interrupt_requests() as self.interrupts:
            if self.run.continuation is not None and not lines:
                self._evaluate()  # the avatar before, which the others are compared with
            self._train()
            if self._is_finished():
                # the timesteps of other splits, whose splats they do not change
                tracking, views = self.trainer.tracking, self.capture.views
                every = {view.timestep for own in views.values() for view in own}
                unseen = every - {view.timestep for view in views["train"]}
                if tracking is not None and tracking.rounds == 1 and unseen:
                    self._track(tracking, sorted(unseen))
            # LPIPS takes long, so a run that is stopped goes without
            self._evaluate(perceptual=self._is_finished())
            self._write_checkpoint()
            if self._is_finished():
                self._tell("Measuring residuals")
                self._write_residuals()
        self._tell("Interrupted" if self.interrupts else "Finished")
        if self.interrupts:
            raise KeyboardInterrupt

    def _train(self) -> None:
        trainer, tracking = self.trainer, self.trainer.tracking
        saved, started, first = self.elapsed_s, self.elapsed_s, trainer.iteration
        asked_s = _asked_interval_s()
        with self._loader() as loader:
            while not self._spent().share >= 1:
                begin = perf_counter()
                view, image, mask, mesh = next(loader)
                loss = trainer.step(view, image, self._spent().share, mask, mesh)
                self.elapsed_s += perf_counter() - begin
                if loss is not None:
                    self.losses.append(loss)
                is_due = tracking is not None and self._spent().share >= TRACKING_START_SHARE
                if tracking is not None and is_due and not tracking.rounds:
                    begin = perf_counter()
                    timesteps = {view.timestep for view in self.capture.views["train"]}
                    self._track(tracking, sorted(timesteps))
                    self.elapsed_s += perf_counter() - begin
                    if not tracking.rounds:
                        break
                if self.evaluator.is_due(self._spent()):
                    self._evaluate()
                    if self._is_finished():
                        break
                if self.elapsed_s - saved > (CHECKPOINT_S if asked_s is None else asked_s):
                    self._write_checkpoint()
                    saved = self.elapsed_s
                elapsed_s = max(self.elapsed_s - started, 1e-9)
                self.speed = (trainer.iteration - first) / elapsed_s
                if self._tell("Training") or self.interrupts:
                    break

    def _loader(self) -> ViewLoader:
        """The views to train from here on."""
        settings, capture, first = self.run.settings, self.capture, self.trainer.iteration
        red, green, blue = (round(255 * c) for c in settings.background)
        if self.run.continuation is None:
            views = capture.views["train"]
            order = view_order(views, settings.views_per_visit, settings.seed, first)
        else:
            region = _refined_region(self.run, self.trainer)
            order = continued_order(self.run.continuation, capture, region, settings.seed, first)

        coarse, full = image_scales(settings, capture.views["train"])

        def scale(position: int) -> float:
            """Of the captured size; by the clock, a few images ahead of it."""
            total = settings.iterations
            share = self._spent().share if total is None else (first + position) / total
            return coarse if share < settings.coarse_share else full

        prepare = image_preparation(capture, settings)
        # refined meshes change with every step
        mesh = capture.mesh if self.trainer.tracking is None else None
        return ViewLoader(order, scale, (red, green, blue), prepare=prepare, mesh=mesh)

    def _track(self, tracking: RefinedTracking, timesteps: list[int]) -> None:
        """Track timesteps by the avatar, one round more; none where the report says to stop."""

        def stops(done: int, total: int) -> bool:
            told = self._tell(f"Tracking by the avatar: {done} of {total}")
            return told or bool(self.interrupts)

        settings, capture = self.run.settings, tracking.refined(self.capture)
        seconds = None if settings.seconds is None else TRACKING_TIME_SHARE * settings.seconds
        try:
            found = track_by_avatar(self._avatar(), settings, capture, timesteps, seconds, stops)
        except Cancelled:
            return
        tracking.take(found, timesteps)
        self.trainer.frames.clear()
        tracking.rounds += 1

    def _evaluate(self, perceptual: bool = False) -> None:
        """Evaluate, keep the avatar where that says so, and append a line of metrics."""
        begin, share, limits = perf_counter(), min(1.0, self._spent().share), None
        if self.trainer.tracking is not None:
            self._measure_refined_strain()
            limits = self.strain_range
        with self.trainer.frames.strain_within(limits):
            render = partial(self.trainer.render, progress=share)
            quality, is_kept = self.evaluator.evaluate(render, perceptual)
        self._require_folder()
        if is_kept:
            self._write_avatar()
        now = perf_counter()
        line = {
            "iteration": self.trainer.iteration,
            "seconds": round(self.elapsed_s, 3),
            "splats": len(self.trainer),
            **({"loss": float(np.mean(self.losses))} if self.losses else {}),
            **quality,
            "evaluation_s": round(now - begin, 3),
            "wall_s": round(now - self.began, 3),
            "peak_memory_mb": peak_memory_mb(),
        }
        append_metrics(self.folder, self.evaluator.record(is_kept, line, self._spent()))

    def _spent(self) -> Spent:
        settings, iterations = self.run.settings, self.trainer.iteration
        if settings.seconds is not None:
            return Spent(self.elapsed_s / settings.seconds, self.elapsed_s, iterations)
        return Spent(iterations / (settings.iterations or 1), self.elapsed_s, iterations)

    def _is_finished(self) -> bool:
        return self.evaluator.is_finished(self._spent())

    def _tell(self, stage: str) -> bool:
        """Report how far the run is; returns whether to stop."""
        spent, evaluator, last = self._spent(), self.evaluator, [{}, *self.evaluator.lines][-1]
        figures = {
            "iteration": spent.iterations, "per_second": self.speed, "left_s": spent.left_s,
            "loss": np.mean(self.losses) if self.losses else None, "psnr": last.get("psnr"),
            "psnr_unmatched": last.get(UNMATCHED), "splats": len(self.trainer),
        }  # fmt: skip

        def known() -> dict[str, float]:
            values = {**figures, "memory_mb": peak_memory_mb()}
            return {name: float(value) for name, value in values.items() if value is not None}

        def preview(path: Path) -> None:
            # training continues without one, and reports a full disk itself
            with suppress(StgaError):
                write_avatar(path, self._avatar())

        share = min(1.0, spent.share)
        return self.report(Progress(share, stage, evaluator.forecast_text, known, preview))

    def _avatar(self) -> Avatar:
        if self.strain_range is None:
            self._measure_refined_strain()
        state, settings = self.trainer.state, self.run.settings
        return Avatar(
            splats=state.averaged(),
            convention=settings.convention,
            neutral=self.capture.neutral.astype(np.float32),
            faces=self.capture.faces,
            settings=to_json(settings),
            regions=dict(self.capture.regions),
            background=settings.background,
            antialiased=settings.antialiased,
            principal_point=self.run.principal_point,
            strain_range=self.strain_range,
            driven_offsets={n: each.average.copy() for n, each in state.driven_offsets.items()},
        )

    def _measure_refined_strain(self) -> None:
        """Measure the strain of the training timesteps, whose meshes refined tracking has moved."""
        if self.run.settings.follows_strain:
            self.strain_range = trained_strain_range(self.capture, self.trainer.frames.mesh, None)

    def _require_folder(self) -> None:
        """Raise StgaError where the folder was moved: writing would make it anew."""
        if not has_run(self.folder) or read_run(self.folder).identity != self.run.identity:
            raise StgaError(
                f"{self.folder}: was moved or deleted while its run trained; resume the run from "
                "its checkpoint, in the folder where it is now"
            )

    def _write_avatar(self) -> None:
        write_avatar(self.folder / AVATAR, self._avatar())
        refined = self.trainer.tracking
        if refined is not None:
            write_tracking(self.folder, refined.sequence, refined.parameters, refined.tracked)

    def _write_checkpoint(self) -> None:
        trainer, tracking, evaluator = self.trainer, self.trainer.tracking, self.evaluator
        assert self.run.identity is not None
        self._require_folder()
        checkpoint = Checkpoint(
            trainer.state, trainer.iteration, trainer.visit, trainer.last_timestep,
            trainer.initial_count, self.elapsed_s, evaluator.best_difference, evaluator.count,
            list(self.losses), None if tracking is None else tracking.parameters,
            0 if tracking is None else tracking.rounds, self.run.identity.digest,
        )  # fmt: skip
        write_checkpoint(self.folder, checkpoint)

    def _write_residuals(self) -> None:
        """Measure the written avatar's error by triangle, over a few views of all frames."""
        capture, settings = self.capture, self.run.settings
        if self.trainer.tracking is not None:
            capture = with_refined_tracking(capture, self.folder)
        views = [view for split in ("train", "val") for view in self.capture.views.get(split, ())]
        shown, prepare = evenly_spread(views, RESIDUAL_VIEWS), image_preparation(capture, settings)
        avatar = read_avatar(self.folder / AVATAR)
        residuals = triangle_residuals(avatar, capture, shown, prepare, RESIDUAL_SCALE)
        write_residuals(self.folder, residuals.mean())


def _begin(
    capture: Capture,
    folder: Path,
    run: Run,
    selection: Mapping[int, np.ndarray] | None,
    report: Report,
) -> _Session:
    """Start a new run: select triangles, by the rule or as given, place splats, write its files."""
    report(Progress(stage="Placing splats"))
    settings, continuation, state = run.settings, run.continuation, None
    if selection is None:
        selective = settings.strategy == "selective"
        selection = select_capture(capture, settings.selection) if selective else {}
    if continuation is not None:
        state = starting_state(continuation, settings, len(capture.faces))
        _check_state(folder, capture, settings, state)
    # of a run whose run.json was removed
    for stale in (TRACKING, CHECKPOINT, METRICS, STRAIN_RANGE, WORLD_FILE):
        (folder / stale).unlink(missing_ok=True)
    session = _session(capture, folder, run, selection, state, report)
    if continuation is not None and (continuation.parent / TRACKING).exists():
        with replacing(folder / TRACKING) as partial_file:
            copyfile(continuation.parent / TRACKING, partial_file)
    assert run.identity is not None
    write_selection(folder, selection, run.identity.digest)
    write_run(folder, run)
    return session


def _resume(capture: Capture, folder: Path, run: Run, report: Report) -> _Session:
    """Continue from the folder's checkpoint. Raises StgaError where it does not fit."""
    report(Progress(stage="Reading the checkpoint"))
    assert run.identity is not None
    found = read_checkpoint(folder)
    if found.identity != run.identity.digest:
        raise StgaError(f"{folder / CHECKPOINT}: {OTHER_RUN}")
    selection = read_selection(folder, len(capture.faces), run.identity.digest)
    _check_state(folder, capture, run.settings, found.state)
    session = _session(capture, folder, run, selection, found.state, report)
    trainer, tracking, evaluator = session.trainer, session.trainer.tracking, session.evaluator
    refined = found.tracking
    if tracking is not None and refined is not None and refined.shape == tracking.tracked.shape:
        # of a version that shifted no torso
        refined = np.pad(refined, ((0, 0), (0, SHIFT_SIZE)))
    wanted = None if tracking is None else tracking.parameters.shape
    if wanted != (None if refined is None else refined.shape):
        text = "its checkpoint's refined tracking does not fit the capture or the settings"
        raise StgaError(f"{folder}: {text}")
    trainer.iteration, trainer.visit = found.iteration, found.visit
    trainer.last_timestep, trainer.initial_count = found.last_timestep, found.initial_count
    if tracking is not None and refined is not None:
        tracking.parameters, tracking.rounds = refined, found.rounds
    session.elapsed_s = found.elapsed_s
    session.losses.extend(found.losses)
    cut_metrics(folder, found.iteration)
    evaluator.lines, evaluator.count = read_metrics(folder), found.evaluations
    evaluator.best_difference = found.best_difference
    if not (folder / AVATAR).exists():
        evaluator.best_difference = math.inf  # so that the next evaluation writes one
    elif not session._is_finished():
        require_color_range(folder / AVATAR, read_avatar(folder / AVATAR))
    write_run(folder, run)  # capture, model and device may be others now
    return session


def _session(
    capture: Capture,
    folder: Path,
    run: Run,
    selection: Mapping[int, np.ndarray],
    state: TrainState | None,
    report: Report,
) -> _Session:
    settings = run.settings
    if settings.follows_strain:
        report(Progress(stage="Measuring strain"))
    strain_range = strain_range_of(folder, capture, run)
    trainer = Trainer(capture, settings, selection, state, run.device, strain_range)
    if run.continuation is not None:
        views = continued_evaluation_views(run, capture, _refined_region(run, trainer))
    else:
        views = [
            read_evaluation_view(capture, view, settings.background, settings.backdrop)
            for view in choose_evaluation_views(capture)
        ]
    rows = settings.exposure  # where images are corrected for it
    exposure = known_exposure(rows, capture.views["train"]) if rows else None
    evaluator = Evaluator(settings, views, run.continuation is not None, exposure)
    return _Session(capture, folder, run, report, trainer, evaluator, strain_range)


def _refined_region(run: Run, trainer: Trainer) -> np.ndarray | None:
    return trainer.strategy.region if run.settings.strategy == "refine" else None


def _check_state(
    folder: Path, capture: Capture, settings: TrainingSettings, state: TrainState
) -> None:
    """Raise StgaError where the checkpoint's splats do not fit the mesh or the settings."""
    face, splats, faces = state.face, state.splats(), len(capture.faces)
    if len(face) and not 0 <= int(face.min()) <= int(face.max()) < faces:
        text = f"its splats refer to triangles that {capture.root} does not have"
        raise StgaError(f"{folder}: {text}")
    if splats.sh_degree != settings.sh_degree:
        text = f"SH degree {splats.sh_degree}, run.json says {settings.sh_degree}"
        raise StgaError(f"{folder}: its splats have {text}")
    for name in {name for name in ADDED if getattr(splats, name).shape[1]} ^ set(settings.added):
        raise StgaError(f"{folder}: its splats and run.json disagree on {name}")
    for name in state.driven_offsets.keys() ^ set(settings.driven_offsets):
        text = f"its checkpoint and run.json disagree on the driven offset {name}"
        raise StgaError(f"{folder}: {text}")
    for name, offset in state.driven_offsets.items():
        if len(offset.steps) != faces:
            text = f"its {name} is of {len(offset.steps)} triangles, {capture.root} has {faces}"
            raise StgaError(f"{folder}: {text}")


def _asked_interval_s() -> float | None:
    """Seconds between checkpoints by the environment variable; None without it."""
    text = os.environ.get(CHECKPOINT_VARIABLE, "")
    with suppress(ValueError):
        if not text or 0 <= float(text) < math.inf:
            return float(text) if text else None
    expected = "expected seconds between checkpoints"
    raise StgaError(f"{CHECKPOINT_VARIABLE}: {expected}, got {shorten(text)}")


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
