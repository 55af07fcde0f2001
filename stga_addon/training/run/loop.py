"""Training loop of a run: evaluations, checkpoints and resumption in a run folder."""

import logging
import signal
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from time import perf_counter
from typing import Any

import numpy as np

from ...avatar.file import Avatar, read_avatar, write_avatar
from ...capture.loader import ViewLoader
from ...capture.model import Capture, evenly_spread
from ...errors import DeviceError, StgaError
from ...files import replacing
from ...format import format_duration
from ...selection import select_capture
from ..effects.decisions import TRACKING
from ..evaluate import lpips
from ..evaluate.evaluation_views import choose_evaluation_views, read_evaluation_view
from ..evaluate.forecast import DETAIL, curve_of, flat_since, forecast, forecast_horizon, forecast_text
from ..evaluate.metrics import evaluate, peak_memory_mb
from ..evaluate.residuals import RESIDUAL_SCALE, triangle_residuals
from ..optimize.exposure import exposure_correction
from ..optimize.flame_refinement import with_refined_tracking, write_tracking
from ..optimize.precompile import precompile_kernels
from ..optimize.state import TrainState
from ..optimize.trainer import Trainer
from ..schedule import image_scale, view_order
from ..settings import to_json
from .checkpoint import OTHER_RUN, Checkpoint, read_checkpoint, read_selection, write_checkpoint, write_selection
from .continuation import continued_evaluation_views, starting_state
from .folder import CHECKPOINT, SELECTION, Run, locked, read_run, write_run
from .metrics_log import METRICS, append_metrics, cut_metrics, read_metrics
from .open_run import check_identity
from .progress import Progress, Report
from .replay import continued_order
from .residual_file import write_residuals
from .strain_range import (
    STRAIN_RANGE,
    read_strain_range,
    require_color_range,
    trained_strain_range,
    write_strain_range,
)

CHECKPOINT_S = 30.0
"""Seconds of training between checkpoints: what a crash may cost."""
EVALUATIONS = 10
"""Evaluations over a budget in iterations, at fixed shares of it so that the run is reproducible."""
RESIDUAL_VIEWS = 24
"""Views in which the residuals of a finished run are measured."""
EVALUATION_SHARE = 0.04
"""Largest share of the training time that evaluations add to a budget in seconds, without the last one."""
MAX_EVALUATIONS = 40
"""Evaluations over a budget in seconds, even where they cost little."""


def train(
    capture: Capture,
    out: Path,
    run: Run,
    selection: dict[int, np.ndarray] | None = None,
    resume: bool = False,
    report: Report = lambda progress: False,
    falls_back: bool = False,
) -> Path:
    """Train a capture into the folder `out` and return the path of the avatar file.

    selection: timestep -> (F,) bool to use instead of the rule. With `resume`, continues from the folder's
    checkpoint to the parameters that an unbroken run would have reached (same seed, number of threads and device).
    falls_back: where a GPU fails, continue from the last checkpoint on the CPU.
    Raises StgaError where the capture has nothing to train on, the folder is in use, is the capture's or holds another
    run or one that cannot be continued (`require_color_range`), or STGA_LPIPS names a file without its weights. A first
    Ctrl-C raises KeyboardInterrupt when avatar and checkpoint are saved, a second one at once.
    """
    try:
        return _train(capture, out, run, selection, resume, report)
    except DeviceError as error:
        if not falls_back:
            raise
        logging.getLogger(__name__).warning("%s; continuing on the CPU from the last checkpoint", error.cause)
    # Outside the handler: the error's traceback would keep the failed loop and its buffers alive.
    report(Progress(message="Continuing on the CPU"))
    return _train(capture, out, replace(run, device="cpu"), selection, True, report)


def _train(
    capture: Capture, out: Path, run: Run, selection: dict[int, np.ndarray] | None, resume: bool, report: Report
) -> Path:
    """`train` on the device of the run."""
    lpips.load_network()  # read now, because it is needed only when everything is trained
    if not capture.views.get("train"):
        raise StgaError(f"{capture.root}: has no training views, so there is nothing to train on")
    if run.settings.target_psnr is not None and not capture.views.get("val"):
        raise StgaError(f"--target-psnr: {capture.root} has no held-out views (split 'val') to measure it on")
    if out.resolve() == capture.root:
        raise StgaError(f"{out}: is the folder of the capture; train into another one")
    with locked(out):
        has_run = (out / "run.json").exists()
        if has_run and not resume:
            raise StgaError(f"{out}: already holds a run; resume it, or choose another folder")
        has_begun = has_run and read_run(out).identity is not None
        run = replace(run, identity=check_identity(out, run, capture))
        report(Progress(message="Compiling kernels"))
        precompile_kernels(run.device)
        loop = _Loop(capture, out, run, report)
        if has_begun and (out / CHECKPOINT).exists():
            loop.resume()
        else:
            if has_begun and selection is None and (out / SELECTION).exists():
                selection = read_selection(out, len(capture.faces), loop.digest)
            loop.begin(selection)
        loop.work()
    return out / "avatar.npz"


@contextmanager
def _interrupt_requests() -> Iterator[list[int]]:
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


class _Loop:
    """The state of `train` between its steps."""

    def __init__(self, capture: Capture, out: Path, run: Run, report: Report) -> None:
        assert run.identity is not None
        self.capture, self.out, self.run, self.report = capture, out, run, report
        self.settings, self.digest = run.settings, run.identity.digest
        self.elapsed, self.best_difference, self.evaluations = 0.0, np.inf, 0
        self.losses: deque[float] = deque(maxlen=100)
        self.lines: list[dict[str, Any]] = []
        self.psnr: float | None = None
        self.speed = 0.0
        self.forecast_text = ""
        self.strain_range: np.ndarray | None = None

    def begin(self, selection: dict[int, np.ndarray] | None) -> None:
        """Start a new run: select triangles, place splats, and write the run's files."""
        self.report(Progress(message="Placing splats"))
        continuation, state = self.run.continuation, None
        if selection is None:
            wanted = self.settings.strategy == "selective"
            selection = select_capture(self.capture, self.settings.selection) if wanted else {}
        if continuation is not None:
            state = starting_state(continuation, self.settings, len(self.capture.faces))
            self._check(state)
        self._measure_strain()
        self.trainer = Trainer(self.capture, self.settings, selection, state, self.run.device, self.strain_range)
        for stale in (TRACKING, CHECKPOINT, METRICS):  # of a run whose run.json was removed
            (self.out / stale).unlink(missing_ok=True)
        if continuation is not None and (continuation.parent / TRACKING).exists():
            with replacing(self.out / TRACKING) as partial:
                copyfile(continuation.parent / TRACKING, partial)
        self._read_evaluation_views()
        write_selection(self.out, selection, self.digest)
        write_run(self.out, self.run)

    def resume(self) -> None:
        """Continue from the folder's checkpoint."""
        self.report(Progress(message="Reading the checkpoint"))
        checkpoint = read_checkpoint(self.out)
        if checkpoint.identity != self.digest:
            raise StgaError(f"{self.out / CHECKPOINT}: {OTHER_RUN}")
        selection = read_selection(self.out, len(self.capture.faces), self.digest)
        self._check(checkpoint.state)
        self._read_or_measure_strain()
        self.trainer = Trainer(
            self.capture, self.settings, selection, checkpoint.state, self.run.device, self.strain_range
        )
        here, there = self.trainer.tracking, checkpoint.tracking
        if (None if here is None else here.tracked.shape) != (None if there is None else there.change.shape):
            raise StgaError(f"{self.out}: its checkpoint's refined tracking does not fit the capture or the settings")
        self.trainer.restore(
            checkpoint.iteration, checkpoint.visit, checkpoint.last_timestep, checkpoint.initial_count,
            checkpoint.tracking,
        )  # fmt: skip
        self.losses.extend(checkpoint.losses)
        self.elapsed, self.best_difference = checkpoint.elapsed_s, checkpoint.best_difference
        self.evaluations = checkpoint.evaluations
        cut_metrics(self.out, checkpoint.iteration)
        self.lines = read_metrics(self.out)
        path = self.out / "avatar.npz"
        if not self._finished() and path.exists():
            require_color_range(path, read_avatar(path))
        self._read_evaluation_views()
        write_run(self.out, self.run)  # capture, model and device may be others now

    def _read_evaluation_views(self) -> None:
        if self.run.continuation is None:
            chosen = choose_evaluation_views(self.capture)
            self.evaluation_views = [read_evaluation_view(self.capture, view) for view in chosen]
        else:
            self.evaluation_views = continued_evaluation_views(self.run, self.capture, self._refined_region())

    def _refined_region(self) -> np.ndarray | None:
        return self.trainer.strategy.region if self.settings.strategy == "refine" else None

    def _check(self, state: TrainState) -> None:
        """Raise StgaError where the checkpoint's splats do not fit the mesh or the settings."""
        face, splats = state.face, state.splats()
        if len(face) and not 0 <= int(face.min()) <= int(face.max()) < len(self.capture.faces):
            raise StgaError(f"{self.out}: its splats refer to triangles that {self.capture.root} does not have")
        if splats.sh_degree != self.settings.sh_degree:
            expected = self.settings.sh_degree
            raise StgaError(f"{self.out}: its splats have SH degree {splats.sh_degree}, run.json says {expected}")
        if bool(splats.strain_color.shape[1]) != self.settings.strain_color:
            raise StgaError(f"{self.out}: its splats and run.json disagree on the effect strain-color")
        position = state.strain_position
        if (position is not None) != self.settings.strain_position:
            raise StgaError(f"{self.out}: its checkpoint and run.json disagree on the effect strain-position")
        if position is not None and len(position.steps) != len(self.capture.faces):
            found, faces = len(position.steps), len(self.capture.faces)
            raise StgaError(f"{self.out}: its positions follow {found} triangles, {self.capture.root} has {faces}")

    def work(self) -> None:
        """Train until the budget is spent, a goal of the settings is reached or the report asks to stop."""
        if self._finished():
            return  # a finished run was resumed
        self.clock_began = perf_counter() - (self.lines[-1]["wall_s"] if self.lines else 0.0)
        with _interrupt_requests() as interrupts:
            if self.run.continuation is not None and not self.lines:
                self._evaluate()  # the avatar before, which the others are compared with
            self._train(interrupts)
            self._evaluate(perceptual=self._finished())  # LPIPS takes long, so a run that is stopped goes without
            self._save()
            if self._finished():
                self._measure_residuals()
        self.report(self._progress("Interrupted" if interrupts else "Finished"))
        if interrupts:
            raise KeyboardInterrupt

    def _train(self, interrupts: list[int]) -> None:
        saved, started, first = self.elapsed, self.elapsed, self.trainer.iteration
        with self._loader() as loader:
            while not self._share() >= 1:
                self._step(loader)
                if self._due():
                    self._evaluate()
                    if self._finished():
                        break
                if self.elapsed - saved > CHECKPOINT_S:
                    self._save()
                    saved = self.elapsed
                self.speed = (self.trainer.iteration - first) / max(self.elapsed - started, 1e-9)
                if self.report(self._progress("Training")) or interrupts:
                    break

    def _loader(self) -> ViewLoader:
        settings, first = self.settings, self.trainer.iteration
        red, green, blue = (round(255 * c) for c in settings.background)
        if self.run.continuation is None:
            order = view_order(self.capture.views["train"], settings.views_per_visit, settings.seed, first)
        else:
            order = continued_order(self.run.continuation, self.capture, self._refined_region(), settings.seed, first)
        correct = exposure_correction(settings)
        mesh = self.capture.mesh if self.trainer.tracking is None else None  # refined meshes change with every step
        return ViewLoader(
            order, lambda position: self._size(first + position), (red, green, blue), correct=correct, mesh=mesh
        )

    def _step(self, loader: ViewLoader) -> None:
        begin = perf_counter()
        view, image, mask, mesh = next(loader)
        loss = self.trainer.step(view, image, self._share(), mask, mesh)
        self.elapsed += perf_counter() - begin
        if loss is not None:
            self.losses.append(loss)

    def _share(self) -> float:
        """Share of the budget spent."""
        if self.settings.seconds is not None:
            return self.elapsed / self.settings.seconds
        return self.trainer.iteration / (self.settings.iterations or 1)

    def _size(self, iteration: int) -> float:
        """Size of an iteration's image, as a share of the captured one; by the clock, a few images ahead of it."""
        total = self.settings.iterations
        return image_scale(self.settings, self._share() if total is None else iteration / total)

    def _due(self) -> bool:
        """Whether to evaluate now; at the end of the budget there is an evaluation anyway."""
        share = self._share()
        if share >= 1 or self.settings.seconds is None:
            return 1 > share >= (self.evaluations + 1) / EVALUATIONS
        # Before the first one: drawing a view takes about half as long as training it.
        cost, last = 0.5 * len(self.evaluation_views) * self.elapsed / self.trainer.iteration, 0.0
        if self.lines:
            cost, last = float(self.lines[-1]["evaluation_s"]), float(self.lines[-1]["seconds"])
        return self.elapsed - last >= max(self.settings.seconds / MAX_EVALUATIONS, cost / EVALUATION_SHARE)

    def _finished(self) -> bool:
        """Whether the budget is spent, the target PSNR is reached, or a stop at a flat curve is due."""
        curve, target = curve_of(self.lines), self.settings.target_psnr
        if self._share() >= 1 or (target is not None and any(psnr >= target for _, psnr in curve)):
            return True
        return self.settings.stop_when_flat and flat_since(self.lines) is not None

    def _evaluate(self, perceptual: bool = False) -> None:
        """Measure the evaluation views, keep the avatar if it is the sharpest so far, and append a line of metrics."""
        share = min(1.0, self._share())
        self.evaluations = max(self.evaluations, int(share * EVALUATIONS))
        begin = perf_counter()
        self._measure_refined_strain()
        line: dict[str, Any] = {
            "iteration": self.trainer.iteration,
            "seconds": round(self.elapsed, 3),
            "splats": len(self.trainer),
        }
        if self.losses:
            line["loss"] = float(np.mean(self.losses))
        if self.evaluation_views:
            limits = None if self.trainer.tracking is None else self.strain_range
            with self.trainer.frames.strain_within(limits):
                quality = evaluate(
                    lambda view: self.trainer.render(view, share),
                    self.evaluation_views,
                    perceptual,
                    matched=bool(self.settings.exposure),
                )
            self.psnr = quality.psnr
            line.update(quality.as_json())
        self._keep_best(line.get(DETAIL))
        now = perf_counter()
        line.update(evaluation_s=round(now - begin, 3), wall_s=round(now - self.clock_began, 3))
        line["peak_memory_mb"] = peak_memory_mb()
        self.lines.append(line)
        self._forecast(line)
        append_metrics(self.out, line)

    def _measure_residuals(self) -> None:
        """Write the error of the avatar on each triangle, over a few views of all frames and cameras."""
        self.report(self._progress("Measuring residuals"))
        views = [view for split in ("train", "val") for view in self.capture.views.get(split, ())]
        mean = triangle_residuals(
            read_avatar(self.out / "avatar.npz"), self._refined_capture(), evenly_spread(views, RESIDUAL_VIEWS),
            exposure_correction(self.settings), RESIDUAL_SCALE,
        ).mean()  # fmt: skip
        write_residuals(self.out, mean)

    def _refined_capture(self) -> Capture:
        """The capture with the meshes that the avatar in the folder was trained on."""
        return self.capture if self.trainer.tracking is None else with_refined_tracking(self.capture, self.out)

    def _keep_best(self, detail_difference: float | None) -> None:
        """Write the avatar if it is the sharpest so far; without evaluation views the latest one is kept.

        Not by PSNR, which prefers an early, blurred state to detail that is a pixel off. A continuation keeps the
        latest one, too: the one before is in the folder of the run that it continues.
        """
        if detail_difference is not None and self.run.continuation is None:
            if not detail_difference <= self.best_difference:
                return
            self.best_difference = detail_difference
        write_avatar(self.out / "avatar.npz", self._avatar())
        if self.trainer.tracking is not None:
            write_tracking(self.out, self.trainer.tracking)

    def _forecast(self, line: dict[str, Any]) -> None:
        """Predict the gain of more training, and add the forecast to the line so that it can be checked later."""
        curve, left = curve_of(self.lines), self._left_s()
        ahead = forecast_horizon(self.elapsed, left)
        predicted = None if ahead is None else forecast(curve, ahead)
        self.forecast_text = "" if ahead is None else forecast_text(self.lines, ahead)
        if predicted is not None and "psnr" in line:
            line["forecast"] = predicted.as_json()
        plateau = flat_since(self.lines) if left else None
        if plateau is not None:
            self.forecast_text = f"no gain since {format_duration(plateau)}: more time no longer helps"
        target, end = self.settings.target_psnr, forecast(curve, left) if left else None
        if target is not None and end is not None and end.psnr + end.error < target:
            far = f"{target:g} dB is out of reach ({end.psnr:.1f} ± {end.error:.1f} dB at the end)"
            self.forecast_text = "; ".join(filter(None, (self.forecast_text, far)))

    def _avatar(self) -> Avatar:
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
            None if state.strain_position is None else state.strain_position.average.copy(),
        )

    def _measure_strain(self) -> None:
        """Measure and write the strain of all training timesteps; refined tracking moves meshes, so not with it."""
        if self._follows_strain() and not self.settings.tracking:
            self.report(Progress(message="Measuring strain"))
            self.strain_range = trained_strain_range(self.capture, self.capture.mesh, self.run.continuation)
            write_strain_range(self.out, self.strain_range, self.digest)

    def _read_or_measure_strain(self) -> None:
        """The file is missing where an earlier version began the run."""
        if (self.out / STRAIN_RANGE).exists() and self._follows_strain():
            self.strain_range = read_strain_range(self.out, len(self.capture.faces), self.digest)
        else:
            self._measure_strain()

    def _follows_strain(self) -> bool:
        return self.settings.strain_color or self.settings.strain_position

    def _measure_refined_strain(self) -> None:
        """With refined tracking, measure all training timesteps where their meshes are now."""
        if self._follows_strain() and self.trainer.tracking is not None:
            self.strain_range = trained_strain_range(self.capture, self.trainer.frames.mesh, None)

    def _save(self) -> None:
        trainer = self.trainer
        checkpoint = Checkpoint(
            trainer.state, trainer.iteration, trainer.visit, trainer.last_timestep, trainer.initial_count,
            self.elapsed, self.best_difference, self.evaluations, list(self.losses),
            None if trainer.tracking is None else trainer.tracking.state, self.digest,
        )  # fmt: skip
        write_checkpoint(self.out, checkpoint)

    def _progress(self, message: str) -> Progress:
        return Progress(
            min(1.0, self._share()),
            self.trainer.iteration,
            self.speed,
            float(np.mean(self.losses)) if self.losses else np.nan,
            self.psnr,
            len(self.trainer),
            self._left_s(),
            message,
            self.forecast_text,
            self._avatar,
        )

    def _left_s(self) -> float:
        """Seconds of training until the budget is spent, at the speed so far."""
        share = self._share()
        return max(0.0, self.elapsed * (1 / share - 1)) if share > 0 else np.nan
