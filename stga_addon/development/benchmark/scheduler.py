"""Benchmark runs trained in turns, so that other load on the machine slows all of them alike."""

import json
import math
import os
import random
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ...errors import StgaError
from ...jobs.perform import request_folder, write_request
from ...jobs.train import Train
from ...progress import Cancelled, Log, Progress, Report, ignore
from ...raster.cpu.threads import threads
from ...training.run.folder import has_run, read_run
from ...worker.launch import same_interpreter_environment
from .variants import without_choices
from .worker import FIT_EXPOSURE, QUALITY, THREADS

TURN_S = 2.0
"""Seconds of training in one turn."""
SAVE_TIMEOUT_S = 60.0
"""Longest wait for an interrupted worker to save its run."""


@dataclass(frozen=True)
class BenchmarkRun:
    """A training whose effects are decided.

    fits_exposure  whether its avatar is measured with fitted exposure (`worker`)
    """

    request: Train
    fits_exposure: bool = False

    @property
    def out(self) -> Path:
        return self.request.run

    @property
    def finished(self) -> bool:
        return (self.out / QUALITY).exists()

    def check(self) -> None:
        """Raise StgaError where the folder holds another run."""
        if not has_run(self.out):
            return
        run = read_run(self.out)
        asked = self.request
        before = run.capture, run.flame, run.principal_point, without_choices(run.settings)
        if before != (asked.capture, asked.flame, asked.principal_point, asked.settings):
            raise StgaError(
                f"{self.out}: holds a run with other settings; choose another --out, or delete it"
            )


def train_in_turns(
    runs: Sequence[BenchmarkRun], log: Log, report: Report = ignore
) -> dict[str, str]:
    """Train all runs, `TURN_S` at a time, in a random order that changes with every round.

    Each run has a process, of which one trains at a time. Finished runs are skipped and interrupted
    ones resumed, so the same call continues where the last one ended. Returns name -> error of the
    runs that failed, which does not stop the others. Raises Cancelled where the report stops it;
    then, and on KeyboardInterrupt, every run is saved.
    """
    workers = [_Worker(run) for run in runs if not run.finished]
    try:
        for worker in workers:  # one at a time, because starting loads the processor too
            log(f"Starting {worker.name}")
            report(Progress(stage="Starting", detail=worker.name))
            worker.start()
        rounds = max(
            (math.ceil((run.request.settings.seconds or 0) / TURN_S) for run in runs), default=1
        )
        rng = random.Random(0)
        for turn in range(1, rounds + 1):
            log(f"Training, turn {turn} of {rounds}")
            for number, worker in enumerate(rng.sample(workers, len(workers))):
                fraction = (turn - 1 + number / len(workers)) / rounds
                if report(Progress(fraction, "Training", f"Turn {turn} of {rounds}")):
                    raise Cancelled
                worker.train_until(turn / rounds)
    finally:
        for worker in workers:
            worker.stop()
        for worker in workers:
            worker.wait()
    return {worker.name: worker.error for worker in workers if worker.error}


class _Worker:
    """The process that trains one run (`worker`)."""

    def __init__(self, run: BenchmarkRun) -> None:
        self.name = run.out.name
        self.error = ""
        self._run = run
        self._process: subprocess.Popen[str] | None = None
        self._ready = False

    def start(self) -> None:
        """Start the process and wait until it is ready to train."""
        if not has_run(self._run.out):
            write_request(request_folder(self._run.out), self._run.request)
        # A session of its own: Ctrl-C reaches only the scheduler, which lets the workers save.
        options = [f"{THREADS}={threads()}", *([FIT_EXPOSURE] if self._run.fits_exposure else [])]
        with (self._run.out / "log.txt").open("a", encoding="utf-8") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", f"{__package__}.worker", str(self._run.out), *options],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=output,
                text=True,
                encoding="utf-8",
                env=same_interpreter_environment(os.environ),
                start_new_session=True,
            )
        self._read_reply()

    def train_until(self, fraction: float) -> None:
        """Train up to a fraction of the budget; returns when that is done."""
        if self._ready:
            assert self._process is not None
            assert self._process.stdin is not None
            with suppress(OSError):  # the process has ended, which reading its reply reports
                self._process.stdin.write(f"{fraction!r}\n")
                self._process.stdin.flush()
            self._read_reply()

    def stop(self) -> None:
        """Close the worker's input, after which it saves the run and ends."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def wait(self) -> None:
        """Wait for the end of the process; kill it after `SAVE_TIMEOUT_S`."""
        if self._process is None:
            return
        try:
            self._process.wait(SAVE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _read_reply(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        output = self._run.out / "log.txt"
        reply = (
            json.loads(line) if line else {"error": f"Worker exited unexpectedly. Log: {output}"}
        )
        self._ready = "fraction" in reply
        self.error = reply.get("error", "")
        # it ends: left unawaited, it would stay a process until the last run is trained
        if not self._ready:
            self.stop()
            self.wait()
