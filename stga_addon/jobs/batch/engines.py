"""The engines that there are: this machine, with as many workers at once as its processors and
memory allow, and those that have a file each."""

import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping

from ...errors import StgaError
from ...worker.launch import start_worker
from ...worker.machine import free_memory_gb, processors
from ...worker.status import inspect_worker
from ...worker.training_python import find_training_python
from ..perform import worker_arguments
from .plan import Ended, Engine, Job

MEMORY_FRACTION = 0.9  # Fraction of the memory that is free at the start that workers may use
GPUS = 1  # Jobs at once that need a GPU to themselves
IS_WINDOWS = os.name == "nt"  # There, a kill is an exit status like others: 1 by the task manager


class LocalEngine(Engine):
    """Starts a worker process per job, as Blender's panel does; a worker outlives the batch's
    process.

    cores, memory_gb   for all workers together; by default what this process may use, and what is
                       free
    """

    def __init__(
        self, cores: int | None = None, memory_gb: float | None = None, python: str | None = None
    ) -> None:
        self._cores = cores or processors()
        self._memory_gb = MEMORY_FRACTION * free_memory_gb() if memory_gb is None else memory_gb
        self._python = python or find_training_python(sys.executable)
        self._jobs: dict[str, tuple[Job, subprocess.Popen[bytes] | None]] = {}

    def has_room(self, job: Job) -> bool:
        """Whether it fits beside what is running; a job larger than the machine runs alone."""
        wanted = [job.resources, *(other.resources for other, _ in self._jobs.values())]
        return len(wanted) == 1 or (
            sum(needs.threads or self._cores for needs in wanted) <= self._cores
            and sum(needs.memory_gb for needs in wanted) <= self._memory_gb
            and sum(needs.gpu for needs in wanted) <= GPUS
        )

    def submit(self, job: Job) -> None:
        folder = job.request_folder
        arguments = worker_arguments(folder, job.resources.threads or None, resume=True)
        self._jobs[job.name] = job, start_worker(folder, self._python, arguments)

    def adopt(self, job: Job) -> None:
        self._jobs[job.name] = job, None

    def running(self) -> Mapping[str, str]:
        return dict.fromkeys(self._jobs, platform.node())

    def ended(self) -> Mapping[str, Ended]:
        found = {}
        for name, (job, process) in list(self._jobs.items()):
            if process is not None and process.poll() is None:
                continue
            snapshot = inspect_worker(job.request_folder, process)
            if not snapshot.state.is_alive:
                del self._jobs[name]
                # killed, unless it is the status of a mistake (2) or of a bug (1)
                code = None if process is None else process.returncode
                is_lost = not code or code < 0 or (IS_WINDOWS and code != 2)
                found[name] = Ended(snapshot, is_lost)
        return found


def _ray(address: str) -> Engine:
    from .ray import RayEngine  # needs the package ray

    return RayEngine(address)


ENGINES: dict[str, tuple[str, Callable[[str], Engine]]] = {
    "local": (
        "this machine, as many jobs as its processors and memory allow",
        lambda _: LocalEngine(),
    ),
    "ray": ("a Ray cluster at --address, or one started here", _ray),
}
"""Name -> what the command line says of it, and what makes it with --address."""


def make_engine(name: str, address: str = "") -> Engine:
    """Raises StgaError where the engine is not there; an address is that of a Ray cluster."""
    if address and name != "ray":
        raise StgaError(f"--address: is that of a Ray cluster; expected --engine ray, got {name}")
    return ENGINES[name][1](address)
