"""Training runs that take turns, so that whatever else the machine does slows all of them alike."""

import json
import math
import os
import random
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ...errors import StgaError
from ...training.run.folder import Run, read_run, write_run
from ...worker.process import same_packages
from .worker import QUALITY

SLICE_S = 2.0
"""Seconds of training in one turn."""
PATIENCE_S = 60.0
"""How long an interrupted race waits for its runs to save what they have."""


@dataclass(frozen=True)
class BenchmarkRun:
    """One run: what it trains, and the folder that keeps it."""

    run: Run
    out: Path

    @property
    def finished(self) -> bool:
        return (self.out / QUALITY).exists()

    def check(self) -> None:
        """Raise StgaError where the folder holds another run."""
        if (self.out / "run.json").exists() and read_run(self.out) != self.run:
            raise StgaError(f"{self.out}: holds a run with other settings; choose another --out, or delete it")


Tell = Callable[[str], None]


def race(jobs: Sequence[BenchmarkRun], tell: Tell) -> None:
    """Train all jobs, a slice of the budget at a time, in an order that changes with every round.

    Each is a process of its own; only one of them works at a time. Finished ones are left alone and interrupted ones
    go on, so calling again with the same jobs takes up where it ended. On KeyboardInterrupt all save what they have.
    A run that fails is told, and the others go on.
    """
    runners = [_Runner(job) for job in jobs if not job.finished]
    try:
        for runner in runners:  # one after the other: the start is work, too
            tell(f"starting {runner.name}")
            runner.start()
        rounds = max((math.ceil((job.run.settings.seconds or 0) / SLICE_S) for job in jobs), default=1)
        shuffled = random.Random(0)
        for turn in range(1, rounds + 1):
            tell(f"training, {turn} of {rounds} turns each")
            for runner in shuffled.sample(runners, len(runners)):
                runner.train_until(turn / rounds)
    finally:
        for runner in runners:
            runner.dismiss()
        for runner in runners:
            runner.end()
    for runner in runners:
        if runner.error:
            tell(f"{runner.name} failed: {runner.error}")


class _Runner:
    """The process of one job, seen from outside."""

    def __init__(self, job: BenchmarkRun) -> None:
        self.job, self.name, self.error = job, job.out.name, ""
        self._process: subprocess.Popen[str] | None = None
        self._waiting = False

    def start(self) -> None:
        """Start the process and wait until it could train."""
        if not (self.job.out / "run.json").exists():
            write_run(self.job.out, self.job.run)
        package = __package__
        # A process of its own group: an interruption reaches only us, and we let it save.
        with (self.job.out / "log.txt").open("a", encoding="utf-8") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", f"{package}.worker", str(self.job.out)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                encoding="utf-8",
                env=same_packages(os.environ),
                start_new_session=True,
            )
        self._listen()

    def train_until(self, share: float) -> None:
        """Let it train up to a share of its budget; returns when it has."""
        if self._waiting:
            assert self._process is not None
            assert self._process.stdin is not None
            with suppress(OSError):  # it has died, as listening will find out
                self._process.stdin.write(f"{share!r}\n")
                self._process.stdin.flush()
            self._listen()

    def dismiss(self) -> None:
        """Tell it that no more turns come."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def end(self) -> None:
        """Wait for its end."""
        if self._process is None:
            return
        try:
            self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _listen(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        message = json.loads(line) if line else {"error": f"its process ended; see {self.job.out / 'log.txt'}"}
        self._waiting = "share" in message
        self.error = message.get("error", "")
