"""Engine of a Ray cluster: one that runs already (its address), or one that is started on this
machine.

A task runs `stga perform` on the job's folder, so that only the command and the exit code go
through Ray's object store. https://docs.ray.io/en/latest/ray-core/tasks.html
"""

import logging
import os
import secrets
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

from ...errors import StgaError
from ...worker.launch import PACKAGES_FOLDER
from ...worker.machine import processors
from ...worker.status import LOG_FILE, inspect_worker, read_status
from ...worker.training_python import PYTHON_VARIABLE
from .plan import Ended, Engine, Job, job_command

MAX_WAITING = 1000
"""Tasks that are submitted at once: more wait here, not in Ray's memory."""
NODE_RETRIES = 5
"""How often Ray restarts a task elsewhere after its machine has gone."""
TOKEN_MODE = "RAY_AUTH_MODE"
"""Environment variable by which a cluster asks for a token (Ray 2.52)."""
TOKEN = "RAY_AUTH_TOKEN"
"""Environment variable of the token."""


class RayEngine(Engine):
    """Submits each job when what it comes after is finished; Ray minds resources."""

    interval_s = 0.2

    def __init__(self, address: str) -> None:
        """Use the cluster at an address; "": one that is started here. Raises StgaError where Ray
        is not installed, or the cluster not reached."""
        if find_spec("ray") is None:
            problem = "the package ray is not installed (it is the extra `ray` of stga-addon)"
            raise StgaError(f"--engine ray: {problem}")
        # other users of this machine cannot submit to it
        if not address and TOKEN_MODE not in os.environ:
            os.environ.update({TOKEN_MODE: "token", TOKEN: secrets.token_hex(32)})
        import ray  # reads the environment

        try:
            # "local": also where another cluster is running on this machine
            options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
            if not address:
                options |= {"num_cpus": processors(), "include_dashboard": False}
            ray.init(address=address or "local", **options)
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            problem = f"Ray cannot be reached ({error})"
            raise StgaError(f"--address {address or 'local'}: {problem}") from error
        self._ray = ray
        self._task = ray.remote(max_retries=NODE_RETRIES)(_task(PYTHON_VARIABLE))
        self._adopted: dict[str, Job] = {}
        self._jobs: dict[Any, Job] = {}

    def has_room(self, job: Job) -> bool:
        return len(self._jobs) < MAX_WAITING

    def submit(self, job: Job) -> None:
        needs = job.resources
        task = self._task.options(
            name=job.name,
            num_cpus=needs.threads or 1,
            num_gpus=int(needs.gpu),
            memory=needs.memory_gb * 1e9,
        )
        log = str(job.request_folder / LOG_FILE)
        self._jobs[task.remote(job_command(job), str(PACKAGES_FOLDER), log)] = job

    def adopt(self, job: Job) -> None:
        self._adopted[job.name] = job

    def running(self) -> Mapping[str, str]:
        """The jobs that have written a status; Ray has no cheap list of waiting tasks."""
        jobs = [*self._jobs.values(), *self._adopted.values()]
        begun = [job for job in jobs if read_status(job.request_folder) is not None]
        return dict.fromkeys((job.name for job in begun), "")

    def ended(self) -> Mapping[str, Ended]:
        found = {}
        for name, job in list(self._adopted.items()):
            snapshot = inspect_worker(job.request_folder)
            if not snapshot.state.is_alive:
                del self._adopted[name]
                found[name] = Ended(snapshot, is_lost=True)
        if self._jobs:
            ready, _ = self._ray.wait(list(self._jobs), num_returns=len(self._jobs), timeout=0)
            for task in ready:
                job = self._jobs.pop(task)
                try:
                    code = self._ray.get(task)
                # its machine or Ray's worker has gone, more often than NODE_RETRIES
                except self._ray.exceptions.RayError:
                    code = -1
                snapshot = inspect_worker(job.request_folder)
                if snapshot.state.is_alive:  # on a machine that Ray had given up
                    self.adopt(job)
                else:
                    found[job.name] = Ended(snapshot, code < 0)
        return found

    def withdraw(self) -> Sequence[str]:
        """Take back the tasks that have not begun."""
        jobs = self._jobs.items()
        waiting = [task for task, job in jobs if read_status(job.request_folder) is None]
        for task in waiting:
            self._ray.cancel(task)
        return [self._jobs.pop(task).name for task in waiting]

    def close(self) -> None:
        self._ray.shutdown()


def _task(python_variable: str) -> Callable[[list[str], str, str], int]:
    """What Ray carries out: sent as it is to machines without this package, it uses only itself."""

    def run_command(command: list[str], packages: str, log: str) -> int:
        """Exit code of a command with its output in a log; on Linux it ends with Ray's worker, as
        does a lost node."""
        import ctypes
        import os
        import signal
        import subprocess
        import sys

        prctl = ctypes.CDLL(None).prctl if sys.platform.startswith("linux") else None

        variables = {**os.environ, "PYTHONPATH": packages}
        command = [variables.get(python_variable) or command[0], *command[1:]]
        # Ray's own settings; the command has its --threads
        for name in ("OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES"):
            variables.pop(name, None)
        # PR_SET_PDEATHSIG
        end_with_this = None if prctl is None else lambda: prctl(1, signal.SIGKILL)
        with open(log, "ab") as out:
            return subprocess.call(
                command,
                env=variables,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                preexec_fn=end_with_this,
            )

    return run_command
