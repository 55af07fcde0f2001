"""A whole training run: from a capture to an avatar in a folder, with evaluation, checkpoints and resumption."""

from collections import deque
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ...avatar.file import Avatar, write_avatar
from ...capture.loader import ViewLoader
from ...capture.model import Capture
from ...errors import StgaError
from ...format import format_duration
from ...selection import select_capture
from ..effect_plan import TRACKING
from ..evaluate import lpips
from ..evaluate.evaluation_views import choose_evaluation_views, read_evaluation_view
from ..evaluate.forecast import curve_of, forecast, forecast_horizon, plateau_start
from ..evaluate.metrics import evaluate, peak_memory_mb
from ..optimize.exposure import exposure_correction
from ..optimize.precompile import precompile_kernels
from ..optimize.tracking import write_tracking
from ..optimize.trainer import Trainer
from ..schedule import image_scale, view_order
from ..settings import to_json
from . import folder as run_folder
from .folder import Checkpoint, Run
from .metrics_log import read_metrics
from .progress import Progress, Report

CHECKPOINT_S = 30.0
"""Seconds of training between checkpoints: what a crash may cost."""
EVALUATIONS = 10
"""Evaluations over a budget in iterations: always the same ones, so that the run repeats."""
EVALUATION_SHARE = 0.04
"""Largest share of the training time that evaluations add to a budget in seconds; the last one comes on top."""
MOST_EVALUATIONS = 40
"""Evaluations over a budget in seconds, however little they cost."""


def train(
    capture: Capture,
    out: Path,
    run: Run,
    selection: dict[int, np.ndarray] | None = None,
    resume: bool = False,
    report: Report = lambda progress: False,
    device: str = "cpu",
) -> Path:
    """Train a capture into the folder `out` and return the path of the avatar file.

    selection: timestep -> (F,) bool to use instead of the rule. With `resume`, continues from the folder's
    checkpoint to the parameters that an unbroken run would have reached (same seed, number of threads and device).
    device: one of `device.choose_device`.
    Raises StgaError where the capture has nothing to train on, the folder is in use or holds another run, or the
    weights of LPIPS are named and are none.
    """
    lpips.load_network()  # read now, because it is needed only when everything is trained
    if not capture.views.get("train"):
        raise StgaError(f"{capture.root}: has no training views, so there is nothing to train on")
    if run.settings.target_psnr is not None and not capture.views.get("val"):
        raise StgaError(f"--target-psnr: {capture.root} has no held-out views (split 'val') to measure it on")
    with run_folder.locked(out):
        if (out / "run.json").exists() and not resume:
            raise StgaError(f"{out}: already holds a run; resume it, or choose another folder")
        report(Progress(message="Compiling kernels"))
        precompile_kernels()
        loop = _Loop(capture, out, run, report, device)
        if resume and (out / "checkpoint.npz").exists():
            loop.resume()
        else:
            if resume and selection is None and (out / "selection.npz").exists():
                selection = run_folder.read_selection(out, len(capture.faces))
            loop.begin(selection)
        loop.work()
    return out / "avatar.npz"


class _Loop:
    """The state of `train` between its steps."""

    def __init__(self, capture: Capture, out: Path, run: Run, report: Report, device: str) -> None:
        self.capture, self.out, self.run, self.report, self.device = capture, out, run, report, device
        self.settings = run.settings
        self.elapsed, self.best, self.evaluations = 0.0, -np.inf, 0
        self.losses: deque[float] = deque(maxlen=100)
        self.lines: list[dict[str, Any]] = []
        self.psnr: float | None = None
        self.forecast_text = ""
        self.evaluation_views = [read_evaluation_view(capture, view) for view in choose_evaluation_views(capture)]

    def begin(self, selection: dict[int, np.ndarray] | None) -> None:
        """Start anew: choose triangles, place splats, and write down what is going to happen."""
        self._tell("Placing splats")
        if selection is None:
            wanted = self.settings.strategy == "selective"
            selection = select_capture(self.capture, self.settings.selection) if wanted else {}
        self.trainer = Trainer(self.capture, self.settings, selection, device=self.device)
        (self.out / TRACKING).unlink(missing_ok=True)  # a run that was here before may have left one
        run_folder.write_selection(self.out, selection)
        run_folder.write_run(self.out, self.run)
        run_folder.cut_metrics(self.out, -1)

    def resume(self) -> None:
        """Take up the folder's checkpoint."""
        self._tell("Reading the checkpoint")
        checkpoint = run_folder.read_checkpoint(self.out)
        selection = run_folder.read_selection(self.out, len(self.capture.faces))
        face = checkpoint.state.face
        if len(face) and not 0 <= int(face.min()) <= int(face.max()) < len(self.capture.faces):
            raise StgaError(f"{self.out}: its splats stand on triangles that {self.capture.root} does not have")
        splats = checkpoint.state.splats()
        if splats.sh_degree != self.settings.sh_degree:
            says = self.settings.sh_degree
            raise StgaError(f"{self.out}: its splats have SH degree {splats.sh_degree}, run.json says {says}")
        if bool(splats.strain_color.shape[1]) != self.settings.strain_color:
            raise StgaError(f"{self.out}: its splats and run.json disagree on whether colours follow strain")
        self.trainer = Trainer(self.capture, self.settings, selection, checkpoint.state, self.device)
        here, there = self.trainer.tracking, checkpoint.tracking
        if (None if here is None else here.tracked.shape) != (None if there is None else there.change.shape):
            raise StgaError(f"{self.out}: its refined tracking is not of this capture, or run.json knows of none")
        self.trainer.continue_from(checkpoint)
        self.losses.extend(checkpoint.losses)
        self.elapsed, self.best = checkpoint.elapsed_s, checkpoint.best_psnr
        self.evaluations = checkpoint.evaluations
        run_folder.cut_metrics(self.out, checkpoint.iteration)
        self.lines = read_metrics(self.out)

    def work(self) -> None:
        """Train until the budget is spent, the settings' goal is reached or the report says stop."""
        if self._share() >= 1 or self._enough():
            return  # a finished run was resumed
        settings, trainer = self.settings, self.trainer
        views = self.capture.views["train"]
        order = view_order(views, settings.views_per_visit, settings.seed, trainer.iteration)
        red, green, blue = (round(255 * c) for c in settings.background)
        correct = exposure_correction(settings)
        saved, started = self.elapsed, self.elapsed
        first = trainer.iteration
        self.clock_began = perf_counter() - (self.lines[-1].get("wall_s", 0.0) if self.lines else 0.0)
        with ViewLoader(
            order,
            lambda position: self._size(first + position),
            (red, green, blue),
            correct=correct,
            mesh=self.capture.mesh if trainer.tracking is None else None,  # refined meshes change with every step
        ) as loader:
            while (share := self._share()) < 1:
                begin = perf_counter()
                view, image, mask, mesh = next(loader)
                loss = trainer.step(view, image, share, mask, mesh)
                self.elapsed += perf_counter() - begin
                if loss is not None:
                    self.losses.append(loss)
                if self._due():
                    self._evaluate()
                    if self._enough():
                        break
                if self.elapsed - saved > CHECKPOINT_S:
                    self._save()
                    saved = self.elapsed
                speed = (trainer.iteration - first) / max(self.elapsed - started, 1e-9)
                if self.report(self._progress(speed)):
                    break
        self._evaluate(perceptual=self._share() >= 1 or self._enough())  # who stops a run is not made to wait
        self._save()
        self.report(self._progress(speed, "Finished"))

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
        return self.elapsed - last >= max(self.settings.seconds / MOST_EVALUATIONS, cost / EVALUATION_SHARE)

    def _enough(self) -> bool:
        """Whether the target is reached, or nothing more is to be gained and the settings say to stop then."""
        curve, target = curve_of(self.lines), self.settings.target_psnr
        if target is not None and any(psnr >= target for _, psnr in curve):
            return True
        return self.settings.stop_when_flat and plateau_start(curve) is not None

    def _evaluate(self, perceptual: bool = False) -> None:
        """Look at the held-out views, keep the avatar if it is the best so far, and write the metrics down."""
        share = min(1.0, self._share())
        self.evaluations = max(self.evaluations, int(share * EVALUATIONS))
        begin = perf_counter()
        line: dict[str, Any] = {
            "iteration": self.trainer.iteration,
            "seconds": round(self.elapsed, 3),
            "splats": len(self.trainer),
        }
        if self.losses:
            line["loss"] = float(np.mean(self.losses))
        if self.evaluation_views:
            quality = evaluate(lambda view: self.trainer.render(view, share), self.evaluation_views, perceptual)
            self.psnr = quality.psnr
            line.update(quality.as_json())
        # Without held-out views the latest avatar counts as the best.
        if not self.evaluation_views or self.psnr is None or self.psnr >= self.best:
            self.best = -np.inf if self.psnr is None else self.psnr
            write_avatar(self.out / "avatar.npz", self._avatar())
            if self.trainer.tracking is not None:
                write_tracking(self.out, self.trainer.tracking)
        now = perf_counter()
        line.update(evaluation_s=round(now - begin, 3), wall_s=round(now - self.clock_began, 3))
        line["peak_memory_mb"] = peak_memory_mb()
        self.lines.append(line)
        self._look_ahead(line)
        run_folder.append_metrics(self.out, line)

    def _look_ahead(self, line: dict[str, Any]) -> None:
        """Say what more time will bring, and note it in the line so that it can be checked."""
        curve, left = curve_of(self.lines), self._left_s()
        ahead = forecast_horizon(self.elapsed, left)
        coming = None if ahead is None else forecast(curve, ahead)
        self.forecast_text = "" if coming is None else str(coming)
        if coming is not None:
            line["forecast"] = coming.as_json()
        level = plateau_start(curve) if left else None
        if level is not None:
            self.forecast_text = f"no gain since {format_duration(level)}: more time no longer helps"
        target, end = self.settings.target_psnr, forecast(curve, left) if left else None
        if target is not None and end is not None and end.psnr + end.error < target:
            far = f"{target:g} dB is out of reach ({end.psnr:.1f} ± {end.error:.1f} dB at the end)"
            self.forecast_text = "; ".join(filter(None, (self.forecast_text, far)))

    def _avatar(self) -> Avatar:
        return Avatar(
            self.trainer.state.averaged(),
            self.settings.convention,
            self.capture.neutral.astype(np.float32),
            self.capture.faces,
            to_json(self.settings),
            dict(self.capture.regions),
            self.settings.background,
            self.settings.antialiased,
        )

    def _save(self) -> None:
        trainer = self.trainer
        run_folder.write_checkpoint(
            self.out,
            Checkpoint(
                trainer.state, trainer.iteration, trainer.visit, trainer.last_timestep, trainer.initial_count,
                self.elapsed, self.best, self.evaluations, list(self.losses),
                None if trainer.tracking is None else trainer.tracking.state,
            ),
        )  # fmt: skip

    def _progress(self, per_second: float, message: str = "Training") -> Progress:
        return Progress(
            min(1.0, self._share()),
            self.trainer.iteration,
            per_second,
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

    def _tell(self, message: str) -> None:
        self.report(Progress(message=message))
