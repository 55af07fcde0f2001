"""Training loop of a run: steps, evaluations and checkpoints in turn."""

import logging
import math
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from ...capture.model import Capture
from ...errors import DeviceError, StgaError, shorten
from ..evaluate import lpips
from ..evaluate.evaluator import Evaluator
from ..evaluate.metrics import peak_memory_mb
from ..optimize.precompile import precompile_kernels
from .checkpoint import read_selection
from .folder import AVATAR, CHECKPOINT, SELECTION, Run, has_run, locked, read_run
from .metrics_log import append_metrics
from .open_run import check_identity
from .progress import Progress, Report
from .session import Session, begin_session, resume_session

_log = logging.getLogger(__name__)
CHECKPOINT_S = 30.0
"""Seconds of training between checkpoints: what a crash may cost."""
CHECKPOINT_VARIABLE = "STGA_CHECKPOINT_S"
"""Environment variable that replaces it, for machines that are taken away often."""


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
        _log.warning("%s; continuing on the CPU from the last checkpoint", error.cause)
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
    """Seconds between checkpoints by the environment variable; None without it. Raises StgaError for no such number."""
    text = os.environ.get(CHECKPOINT_VARIABLE, "")
    if not text:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < math.inf:
        raise StgaError(f"{CHECKPOINT_VARIABLE}: expected seconds between checkpoints, got {shorten(text)}")
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
        """Train until the budget is spent, a goal of the settings is reached or the report asks to stop."""
        self.report(self._progress("Compiling kernels"))  # meanwhile, the splats are shown as they begin
        precompile_kernels(self.session.run.device)
        self.began = perf_counter() - (self.evaluator.lines[-1]["wall_s"] if self.evaluator.lines else 0.0)
        if self._is_finished():  # a finished run was resumed
            self._restore_avatar()
            return
        with interrupt_requests() as interrupts:
            if self.session.run.continuation is not None and not self.evaluator.lines:
                self._evaluate()  # the avatar before, which the others are compared with
            self._train(interrupts)
            if self._is_finished():
                self.session.track_unseen(self._tracks(interrupts))
            self._evaluate(perceptual=self._is_finished())  # LPIPS takes long, so a run that is stopped goes without
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
        _log.warning("%s was missing; it is written anew from the checkpoint, the last state of training", path)
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
                if session.tracking_is_due and not session.track(perf_counter, self._tracks(interrupts)):
                    break
                if self.evaluator.is_due(session.spent()):
                    self._evaluate()
                    if self._is_finished():
                        break
                if session.elapsed_s - saved > (CHECKPOINT_S if asked_s is None else asked_s):
                    session.write_checkpoint(self.evaluator)
                    saved = session.elapsed_s
                self.speed = (session.trainer.iteration - first) / max(session.elapsed_s - started, 1e-9)
                if self.report(self._progress("Training")) or interrupts:
                    break

    def _tracks(self, interrupts: list[int]) -> Callable[[int, int], bool]:
        """What tracking by the avatar reports to."""
        return lambda done, total: (
            self.report(self._progress(f"Tracking by the avatar: {done} of {total}")) or bool(interrupts)
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

    def _progress(self, message: str) -> Progress:
        session, spent = self.session, self.session.spent()
        return Progress(
            min(1.0, spent.share),
            spent.iterations,
            self.speed,
            np.nan if session.loss is None else session.loss,
            self.evaluator.psnr,
            len(session.trainer),
            spent.left_s,
            message,
            self.evaluator.forecast_text,
            session.avatar,
            self.evaluator.psnr_unmatched,
        )


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
