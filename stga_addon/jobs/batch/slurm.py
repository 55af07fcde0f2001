"""Engine of a SLURM cluster: an sbatch array of jobs of the same kind and needs, with dependencies
between the arrays.

https://slurm.schedmd.com/sbatch.html. The jobs of a machine that dies are put back into the queue
(--requeue), and continue from their checkpoints. Liveness is squeue's, state and figures are those
of the jobs' folders. The batch's folder `slurm` has the scripts, and SUBMITTED: what the next start
watches in the queue and does not submit again.
"""

import re
import shlex
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from ...errors import StgaError
from ...files import read_json, replacing, write_json
from ...worker.launch import PACKAGES_FOLDER
from ...worker.status import LOG_FILE, WorkerState, inspect_worker
from .plan import Ended, Engine, Job, Resources, job_command, kind_name

TIMEOUT_S = 60.0
MAX_ARRAY = 1000  # Jobs of an array: SLURM's default MaxArraySize is 1001
QUEUE_FORMAT = "%i|%T|%N"  # Of squeue: job, state, machines
ON_MACHINE = ("RUNNING", "COMPLETING", "CONFIGURING", "STAGE_OUT")
GRACE_S = 10.0
"""Seconds after its submission in which a job that squeue does not list yet is not gone."""
MAX_SILENCE_S = 600.0  # How long squeue may fail before the batch ends; its jobs go on
FOLDER = "slurm"
SUBMITTED = "submitted.json"


@dataclass
class _Submitted:
    """A job, its name in SLURM ("12_3") and when it was submitted."""

    job: Job
    name: str
    since: float


class SlurmEngine(Engine):
    """Submits every job at once; SLURM's scheduler minds resources and dependencies."""

    takes_all = True
    interval_s = 2.0

    def __init__(self) -> None:
        """Raises StgaError where SLURM's programs are missing."""
        programs = "sbatch", "squeue", "scancel"
        missing = next((name for name in programs if shutil.which(name) is None), None)
        if missing is not None:
            problem = f"the program {missing} was not found; start it where SLURM is installed"
            raise StgaError(f"--engine slurm: {problem}")
        self._jobs: dict[str, _Submitted] = {}
        self._names: dict[str, str] | None = None
        self._states: dict[str, tuple[str, str]] | None = None
        self._answered_s = time.monotonic()

    def submit(self, jobs: Sequence[Job]) -> None:
        """Submit the jobs but those that are in the queue since an earlier start. Raises StgaError
        with sbatch's words, and where squeue does not answer."""
        names = {job.name: self._name(job) for job in jobs}
        if self._states is None and any(names.values()):
            self._states = _queue()
        queued = self._states or {}
        for job in jobs:
            if names[job.name] in queued:
                self.adopt(job)
        for array in _in_arrays([job for job in jobs if names[job.name] not in queued]):
            self._submit_array(array)

    def _name(self, job: Job) -> str:
        """The job's name in SLURM when it was submitted last; "" where it never was."""
        if self._names is None:
            self._names = {}
            with suppress(StgaError):
                values = read_json(job.folder.parent / FOLDER / SUBMITTED)
                self._names |= values if isinstance(values, dict) else {}
        return str(self._names.get(job.name, ""))

    def _submit_array(self, jobs: Sequence[Job]) -> None:
        kind = kind_name(type(jobs[0].request))
        needs = jobs[0].resources
        script = jobs[0].folder.parent / FOLDER / f"{kind}-{time.time_ns()}.sh"
        with replacing(script) as partial:
            packages = shlex.quote(str(PACKAGES_FOLDER))
            lines = ["#!/bin/sh", "# A batch of stga; each job continues what it began before."]
            lines += [f"export PYTHONPATH={packages}", "case $SLURM_ARRAY_TASK_ID in"]
            for index, job in enumerate(jobs):
                log = shlex.quote(str(job.request_folder / LOG_FILE))
                lines.append(f"{index}) exec {shlex.join(job_command(job))} >>{log} 2>&1 ;;")
            partial.write_text("\n".join([*lines, "esac", ""]), encoding="utf-8")
        others = {other for job in jobs for other in job.after if other in self._jobs}
        names = (self._jobs[other].name for other in others)
        waits = sorted({_array(name) for name in names if name})
        command = [
            "sbatch",
            "--parsable",
            "--requeue",
            "--output=/dev/null",
            f"--job-name=stga-{kind}",
            f"--array=0-{len(jobs) - 1}",
            f"--cpus-per-task={needs.threads or 1}",
            f"--mem={round(1000 * needs.memory_gb)}M",
            *(["--gres=gpu:1"] if needs.gpu else []),
            *([f"--dependency=afterany:{':'.join(waits)}"] if waits else []),
            str(script),
        ]
        array = _call(command).strip().partition(";")[0]
        for index, job in enumerate(jobs):
            self._jobs[job.name] = _Submitted(job, f"{array}_{index}", time.monotonic())
        submitted = {job.name: self._jobs[job.name].name for job in jobs}
        self._names = {**(self._names or {}), **submitted}
        write_json(script.with_name(SUBMITTED), self._names)

    def adopt(self, job: Job) -> None:
        self._jobs[job.name] = _Submitted(job, self._name(job), time.monotonic())

    def running(self) -> Mapping[str, str]:
        states = self._states or {}
        found = {name: states.get(one.name, ("", "")) for name, one in self._jobs.items()}
        return {name: machine for name, (state, machine) in found.items() if state in ON_MACHINE}

    def _ask(self) -> bool:
        """Whether squeue answers what is in the queue; StgaError after MAX_SILENCE_S."""
        try:
            self._states = _queue()
        except StgaError:
            if time.monotonic() - self._answered_s > MAX_SILENCE_S:
                raise
            return False
        self._answered_s = time.monotonic()
        return True

    def ended(self) -> Mapping[str, Ended]:
        if not self._ask():
            return {}
        states = self._states or {}
        found = {}
        for name, one in list(self._jobs.items()):
            if one.name in states:
                continue
            snapshot = inspect_worker(one.job.request_folder)
            is_new = one.name and time.monotonic() - one.since < GRACE_S
            has_not_begun = snapshot.state in (WorkerState.NONE, WorkerState.LOST)
            if snapshot.state.is_alive or (is_new and has_not_begun):
                continue
            del self._jobs[name]
            found[name] = Ended(snapshot, is_lost=True)
        return found

    def withdraw(self) -> Sequence[str]:
        """Take back the jobs that wait in the queue."""
        self._ask()
        pending = {name for name, (state, _) in (self._states or {}).items() if state == "PENDING"}
        waiting = [name for name, one in self._jobs.items() if one.name in pending]
        if waiting:
            arrays = {_array(self._jobs[name].name) for name in waiting}
            _call(["scancel", "--state=PENDING", *sorted(arrays)])
        for name in waiting:
            del self._jobs[name]
        return waiting


def _array(name: str) -> str:
    """ "12" of the job "12_3"."""
    return name.partition("_")[0]


def _in_arrays(jobs: Sequence[Job]) -> list[list[Job]]:
    """Arrays of the same kind and needs, as many steps from the first: none waits for a later."""
    step: dict[str, int] = {}
    arrays: dict[tuple[int, str, Resources, int], list[Job]] = {}
    for job in jobs:
        step[job.name] = 1 + max((step[other] for other in job.after if other in step), default=0)
        key = (step[job.name], kind_name(type(job.request)), job.resources)
        number = 0
        while len(arrays.setdefault((*key, number), [])) == MAX_ARRAY:
            number += 1
        arrays[*key, number].append(job)
    return [arrays[key] for key in sorted(arrays, key=lambda key: key[0])]


def _queue() -> dict[str, tuple[str, str]]:
    """Job in SLURM -> state and machine, of this user's jobs."""
    command = ["squeue", "--me", "--noheader", "--array", f"--format={QUEUE_FORMAT}"]
    lines = _call(command).splitlines()
    rows = [line.split("|") for line in lines if line.count("|") == 2]
    return {job: (state, machine) for job, state, machine in rows if re.fullmatch(r"\d+_\d+", job)}


def _call(command: Sequence[str]) -> str:
    """Output of one of SLURM's programs. Raises StgaError with its message."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise StgaError(f"{command[0]}: cannot be run ({error})") from error
    if done.returncode:
        raise StgaError(f"{command[0]}: {done.stderr.strip() or f'exit status {done.returncode}'}")
    return done.stdout
