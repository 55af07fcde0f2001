"""Session of a run in its folder: begun or resumed, trained step by step, and written."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np

from ...avatar.file import Avatar, read_avatar, write_avatar
from ...avatar.splats import ADDED
from ...capture.loader import ViewLoader
from ...capture.model import Capture, ViewExposure, evenly_spread
from ...errors import StgaError
from ...files import replacing
from ...progress import Cancelled
from ...schema import to_json
from ...selection import select_capture
from ..evaluate.evaluation_views import EvaluationView, choose_evaluation_views, read_evaluation_view
from ..evaluate.evaluator import Evaluation, Evaluator, Spent
from ..evaluate.match_exposure import known_exposure
from ..evaluate.residuals import RESIDUAL_SCALE, triangle_residuals
from ..optimize.avatar_tracking import track_by_avatar
from ..optimize.image_preparation import image_preparation
from ..optimize.state import TrainState
from ..optimize.trainer import Trainer
from ..schedule import image_scale, view_order
from ..settings import TrainingSettings
from .checkpoint import OTHER_RUN, Checkpoint, read_checkpoint, read_selection, write_checkpoint, write_selection
from .continuation import continued_evaluation_views, starting_state
from .folder import AVATAR, CHECKPOINT, RUN, WORLD_FILE, Run, read_run, write_run
from .metrics_log import METRICS, cut_metrics, read_metrics
from .progress import Progress, Report
from .replay import continued_order
from .residual_file import write_residuals
from .strain_range import STRAIN_RANGE, require_color_range, strain_range_of, trained_strain_range
from .tracking_file import TRACKING, with_refined_tracking, write_tracking

TRACKING_START_SHARE, TRACKING_TIME_SHARE = 0.5, 0.2
"""Of the budget, after which the avatar tracks its head; and of a budget in seconds, what that may take."""
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
            order = view_order(self.capture.views["train"], settings.views_per_visit, settings.seed, first)
        else:
            region = _refined_region(self.run, self.trainer)
            order = continued_order(self.run.continuation, self.capture, region, settings.seed, first)
        prepare = image_preparation(self.capture, settings)
        mesh = self.capture.mesh if self.trainer.tracking is None else None  # refined meshes change with every step
        return ViewLoader(
            order, lambda position: self._scale(first + position), (red, green, blue), prepare=prepare, mesh=mesh
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
        return tracking is not None and not tracking.rounds and self.spent().share >= TRACKING_START_SHARE

    def track(self, clock: Callable[[], float], report: Callable[[int, int], bool]) -> bool:
        """Track the training's timesteps by the avatar; returns False where the report said to stop."""
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
            self._tracked(unseen, None if seconds is None else TRACKING_TIME_SHARE * seconds, report)
            tracking.rounds += 1

    def _tracked(self, timesteps: list[int], seconds: float | None, report: Callable[[int, int], bool]) -> bool:
        tracking = self.trainer.tracking
        assert tracking is not None
        try:
            found = track_by_avatar(
                self.avatar(), self.settings, tracking.refined(self.capture), timesteps, seconds, report
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
        """Raise StgaError where the run is no longer in its folder, which writing would make anew."""
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
        """Measure the error of the written avatar on each triangle, over a few views of all frames and cameras."""
        views = [view for split in ("train", "val") for view in self.capture.views.get(split, ())]
        refined = self.trainer.tracking is not None
        capture = with_refined_tracking(self.capture, self.folder) if refined else self.capture
        residuals = triangle_residuals(
            read_avatar(self.folder / AVATAR), capture, evenly_spread(views, RESIDUAL_VIEWS),
            image_preparation(capture, self.settings), RESIDUAL_SCALE,
        )  # fmt: skip
        write_residuals(self.folder, residuals.mean())

    def _scale(self, iteration: int) -> float:
        """Size of an iteration's image, as a share of the captured one; by the clock, a few images ahead of it."""
        total = self.settings.iterations
        return image_scale(self.settings, self.spent().share if total is None else iteration / total)

    def _measure_refined_strain(self) -> None:
        """Measure the strain of all training timesteps where refined tracking has moved their meshes."""
        if self.settings.follows_strain:
            self.strain_range = trained_strain_range(self.capture, self.trainer.frames.mesh, None)


def begin_session(
    capture: Capture, folder: Path, run: Run, selection: dict[int, np.ndarray] | None, report: Report
) -> tuple[Session, Evaluator]:
    """Start a new run: select triangles, place splats, and write the run's files.

    selection: timestep -> (F,) bool to train; None: by the rule.
    """
    report(Progress(message="Placing splats"))
    settings, continuation, state = run.settings, run.continuation, None
    if selection is None:
        selection = select_capture(capture, settings.selection) if settings.strategy == "selective" else {}
    if continuation is not None:
        state = starting_state(continuation, settings, len(capture.faces))
        _check_state(folder, capture, settings, state)
    for stale in (TRACKING, CHECKPOINT, METRICS, STRAIN_RANGE, WORLD_FILE):  # of a run whose run.json was removed
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


def resume_session(capture: Capture, folder: Path, run: Run, report: Report) -> tuple[Session, Evaluator]:
    """Continue from the folder's checkpoint. Raises StgaError where it does not fit the capture or the settings."""
    report(Progress(message="Reading the checkpoint"))
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
    if (None if here is None else here.tracked.shape) != (None if there is None else there.shape):
        raise StgaError(f"{folder}: its checkpoint's refined tracking does not fit the capture or the settings")
    trainer.restore(checkpoint.iteration, checkpoint.visit, checkpoint.last_timestep, checkpoint.initial_count)
    if here is not None and there is not None:
        here.parameters, here.rounds = there, checkpoint.rounds


def _strain_range(folder: Path, capture: Capture, run: Run, report: Report) -> np.ndarray | None:
    if run.settings.follows_strain:
        report(Progress(message="Measuring strain"))
    return strain_range_of(folder, capture, run)


def _evaluation_views(capture: Capture, run: Run, trainer: Trainer) -> list[EvaluationView]:
    if run.continuation is not None:
        return continued_evaluation_views(run, capture, _refined_region(run, trainer))
    background, backdrop = run.settings.background, run.settings.backdrop
    return [read_evaluation_view(capture, view, background, backdrop) for view in choose_evaluation_views(capture)]


def _exposure(capture: Capture, run: Run) -> ViewExposure | None:
    """`known_exposure` where images are corrected for it."""
    rows = run.settings.exposure
    return known_exposure(rows, capture.views["train"]) if rows else None


def _refined_region(run: Run, trainer: Trainer) -> np.ndarray | None:
    return trainer.strategy.region if run.settings.strategy == "refine" else None


def _check_state(folder: Path, capture: Capture, settings: TrainingSettings, state: TrainState) -> None:
    """Raise StgaError where the checkpoint's splats do not fit the mesh or the settings."""
    face, splats, faces = state.face, state.splats(), len(capture.faces)
    if len(face) and not 0 <= int(face.min()) <= int(face.max()) < faces:
        raise StgaError(f"{folder}: its splats refer to triangles that {capture.root} does not have")
    if splats.sh_degree != settings.sh_degree:
        found = splats.sh_degree
        raise StgaError(f"{folder}: its splats have SH degree {found}, run.json says {settings.sh_degree}")
    for name in {name for name in ADDED if getattr(splats, name).shape[1]} ^ set(settings.added):
        raise StgaError(f"{folder}: its splats and run.json disagree on {name}")
    for name in state.driven_offsets.keys() ^ set(settings.driven_offsets):
        raise StgaError(f"{folder}: its checkpoint and run.json disagree on the driven offset {name}")
    for name, offset in state.driven_offsets.items():
        found = len(offset.steps)
        if found != faces:
            raise StgaError(f"{folder}: its {name} is of {found} triangles, {capture.root} has {faces}")
