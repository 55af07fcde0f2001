"""What an engine is: it carries out jobs whose folders are prepared. `engines.table` lists those that there are."""

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from ..requests.folder import worker_arguments
from ..worker.status import WorkerSnapshot
from ..worker.training_python import PYTHON_VARIABLE
from .job import Job


@dataclass(frozen=True)
class Ended:
    """What became of a job's worker. is_lost: it was killed, or its machine has gone; the job may be tried again."""

    snapshot: WorkerSnapshot
    is_lost: bool = False


class Engine(Protocol):
    """Carries out jobs.

    takes_all    it is given all jobs at once, and minds what they come after itself; else each when it can start
    interval_s   seconds between two questions after what has ended
    """

    takes_all: bool
    interval_s: float

    def has_room(self, job: Job) -> bool:
        """Whether the job can be submitted now."""

    def submit(self, jobs: Sequence[Job]) -> None:
        """Carry out jobs, which follow those that they come after. Raises StgaError where that cannot be begun."""

    def adopt(self, job: Job) -> None:
        """Watch the worker that an earlier start of the batch left running."""

    def running(self) -> Mapping[str, str]:
        """Name of each job that a machine carries out -> the machine, "" where only the worker knows it."""

    def ended(self) -> Mapping[str, Ended]:
        """The jobs whose workers have ended since this was called last."""

    def withdraw(self) -> Sequence[str]:
        """Take back what was submitted and has not begun; returns the names of these jobs."""

    def close(self) -> None:
        """Leave the engine; the work of running jobs is not touched."""


def job_command(job: Job) -> list[str]:
    """What a machine that sees the job's folder runs."""
    arguments = worker_arguments(job.request_folder, job.resources.threads or None, resume=True)
    return [training_python(), "-m", *arguments]


def training_python() -> str:
    """The interpreter that carries out jobs: that of STGA_PYTHON, else this one."""
    return os.environ.get(PYTHON_VARIABLE) or sys.executable
