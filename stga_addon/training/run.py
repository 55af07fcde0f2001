"""A whole training run: from a capture to an avatar in a folder, with evaluation, checkpoints and resumption."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from ..avatar.file import Avatar, write_avatar
from ..capture.loader import ViewLoader
from ..capture.model import Capture, View
from ..errors import StgaError
from ..selection import select_capture
from . import folder as run_folder
from .folder import Checkpoint, Run
from .metrics import evaluate
from .schedule import view_order
from .settings import to_json
from .trainer import Trainer
from .warm import compile_kernels

CHECKPOINT_S = 30.0
"""Seconds of training between checkpoints: what a crash may cost."""
EVALUATIONS = 10
"""Evaluations over the budget."""
MOST_VIEWS = 16
"""Held-out views that an evaluation during training looks at, evenly spread; it should cost a few per cent."""


@dataclass(frozen=True)
class Progress:
    """What a person sees while it trains: share of the budget, iterations, speed, loss (mean of the last global
    iterations), PSNR of the last evaluation or None, splat count, seconds left, and what is going on."""

    share: float
    iteration: int
    per_second: float
    loss: float
    psnr: float | None
    splats: int
    left_s: float
    message: str = ""


Report = Callable[[Progress], bool]
"""Called after every iteration; answers True to stop early, keeping what is trained."""


def train(
    capture: Capture,
    out: Path,
    run: Run,
    selection: dict[int, np.ndarray] | None = None,
    resume: bool = False,
    report: Report = lambda progress: False,
) -> Path:
    """Train a capture into the folder `out` and return the path of the avatar file.

    selection: timestep -> (F,) bool to use instead of the rule. With `resume`, continues from the folder's
    checkpoint to the parameters that an unbroken run would have reached (same seed and number of threads).
    Raises StgaError where the capture has nothing to train on, or the folder is in use or holds another run.
    """
    if not capture.views.get("train"):
        raise StgaError(f"{capture.root}: has no training views, so there is nothing to train on")
    with run_folder.locked(out):
        if (out / "run.json").exists() and not resume:
            raise StgaError(f"{out}: already holds a run; resume it, or choose another folder")
        report(Progress(0, 0, 0, np.nan, None, 0, np.nan, "compiling kernels"))
        compile_kernels()
        loop = _Loop(capture, out, run, report)
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

    def __init__(self, capture: Capture, out: Path, run: Run, report: Report) -> None:
        self.capture, self.out, self.run, self.report = capture, out, run, report
        self.settings = run.settings
        self.elapsed, self.best, self.evaluations = 0.0, -np.inf, 0
        self.losses: deque[float] = deque(maxlen=100)
        self.psnr: float | None = None

    def begin(self, selection: dict[int, np.ndarray] | None) -> None:
        """Start anew: choose triangles, place splats, and write down what is going to happen."""
        self._tell("choosing triangles and placing splats")
        if selection is None:
            wanted = self.settings.strategy == "selective"
            selection = select_capture(self.capture, self.settings.selection) if wanted else {}
        self.trainer = Trainer(self.capture, self.settings, selection)
        run_folder.write_selection(self.out, selection)
        run_folder.write_run(self.out, self.run)
        run_folder.cut_metrics(self.out, -1)

    def resume(self) -> None:
        """Take up the folder's checkpoint."""
        self._tell("reading the checkpoint")
        checkpoint = run_folder.read_checkpoint(self.out)
        selection = run_folder.read_selection(self.out, len(self.capture.faces))
        face = checkpoint.state.face
        if len(face) and not 0 <= int(face.min()) <= int(face.max()) < len(self.capture.faces):
            raise StgaError(f"{self.out}: its splats stand on triangles that {self.capture.root} does not have")
        degree = checkpoint.state.splats().sh_degree
        if degree != self.settings.sh_degree:
            raise StgaError(f"{self.out}: its splats have SH degree {degree}, run.json says {self.settings.sh_degree}")
        self.trainer = Trainer(self.capture, self.settings, selection, checkpoint.state)
        self.trainer.continue_from(checkpoint)
        self.losses.extend(checkpoint.losses)
        self.elapsed, self.best = checkpoint.elapsed_s, checkpoint.best_psnr
        self.evaluations = checkpoint.evaluations
        run_folder.cut_metrics(self.out, checkpoint.iteration)

    def work(self) -> None:
        """Train until the budget is spent or the report says stop."""
        if self._share() >= 1:
            return  # a finished run was resumed
        settings, trainer = self.settings, self.trainer
        views = self.capture.views["train"]
        order = view_order(views, settings.views_per_visit, settings.seed, trainer.iteration)
        background = tuple(round(255 * c) for c in settings.background)
        saved, started = self.elapsed, self.elapsed
        first = trainer.iteration
        with ViewLoader(order, background=background) as loader:  # type: ignore[arg-type]
            while (share := self._share()) < 1:
                begin = perf_counter()
                view, image, mask = next(loader)
                loss = trainer.step(view, image, share, mask)
                self.elapsed += perf_counter() - begin
                if loss is not None:
                    self.losses.append(loss)
                if 1 > self._share() >= (self.evaluations + 1) / EVALUATIONS:
                    self._evaluate()
                if self.elapsed - saved > CHECKPOINT_S:
                    self._save()
                    saved = self.elapsed
                speed = (trainer.iteration - first) / max(self.elapsed - started, 1e-9)
                if self.report(self._progress(speed)):
                    break
        self._evaluate(last=True)
        self._save()

    def _share(self) -> float:
        """Share of the budget spent."""
        if self.settings.seconds is not None:
            return self.elapsed / self.settings.seconds
        return self.trainer.iteration / (self.settings.iterations or 1)

    def _evaluate(self, last: bool = False) -> None:
        """Look at the held-out views, write the metrics down, and keep the avatar if it is the best so far."""
        share = min(1.0, self._share())
        self.evaluations = max(self.evaluations, int(share * EVALUATIONS))
        views = watch_views(self.capture)
        begin = perf_counter()
        line = {
            "iteration": self.trainer.iteration,
            "seconds": round(self.elapsed, 3),
            "splats": len(self.trainer.state),
        }
        if self.losses:
            line["loss"] = float(np.mean(self.losses))
        if views:
            quality = evaluate(lambda view: self.trainer.draw(view, share), views, perceptual=last)
            self.psnr = quality.psnr
            line.update(quality.as_json())
        run_folder.append_metrics(self.out, {**line, "evaluation_s": round(perf_counter() - begin, 3)})
        # Without held-out views the latest avatar counts as the best.
        if not views or self.psnr is None or self.psnr >= self.best:
            self.best = -np.inf if self.psnr is None else self.psnr
            write_avatar(self.out / "avatar.npz", self._avatar())

    def _avatar(self) -> Avatar:
        return Avatar(
            self.trainer.state.splats(),
            self.settings.convention,
            self.capture.neutral.astype(np.float32),
            self.capture.faces,
            to_json(self.settings),
            dict(self.capture.regions),
            self.settings.background,
        )

    def _save(self) -> None:
        trainer = self.trainer
        run_folder.write_checkpoint(
            self.out,
            Checkpoint(
                trainer.state, trainer.iteration, trainer.visit, trainer.last_timestep, trainer.initial_count,
                self.elapsed, self.best, self.evaluations, list(self.losses),
            ),
        )  # fmt: skip

    def _progress(self, per_second: float) -> Progress:
        share = min(1.0, self._share())
        if self.settings.seconds is not None:
            left = self.settings.seconds - self.elapsed
        else:
            left = ((self.settings.iterations or 0) - self.trainer.iteration) / max(per_second, 1e-9)
        loss = float(np.mean(self.losses)) if self.losses else np.nan
        count = len(self.trainer.state)
        return Progress(share, self.trainer.iteration, per_second, loss, self.psnr, count, max(0.0, left), "training")

    def _tell(self, message: str) -> None:
        self.report(Progress(0, 0, 0, np.nan, None, 0, np.nan, message))


def watch_views(capture: Capture) -> Sequence[View]:
    """The held-out views that are looked at while training: at most MOST_VIEWS, evenly spread."""
    views = capture.views.get("val", ())
    if len(views) <= MOST_VIEWS:
        return views
    return [views[n] for n in np.linspace(0, len(views) - 1, MOST_VIEWS).round().astype(int)]
