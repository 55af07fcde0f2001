"""Running a batch: which jobs are to be done, what each comes after, and what became of it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum

from filelock import SoftFileLease

from ...errors import StgaError
from ...worker.status import WorkerState, WorkerStatus, read_status, request_cancel
from .folder import is_done, is_running, job_digests, prepare, read_record, write_record
from .plan import Engine, Job, Plan

MAX_RETRIES = 5  # How often a job whose worker was killed is tried again in one start of a batch
SHOW_INTERVAL_S = 1.0
MAX_BEGUN = 64  # Jobs that are begun before the next look at what has ended
MAX_MISSES = 50  # Jobs that are asked for in vain, in a row, before the next look at what has ended
Log = Callable[[str], None]


class JobState(StrEnum):
    """State of a job in this start of the batch."""

    WAITING = "waiting"
    RUNNING = "running"
    FINISHED = "finished"
    KEPT = "finished before"
    FAILED = "failed"
    BLOCKED = "not started"
    CANCELLED = "stopped"

    @property
    def is_done(self) -> bool:
        return self in (JobState.FINISHED, JobState.KEPT)

    @property
    def is_over(self) -> bool:
        return self not in (JobState.WAITING, JobState.RUNNING)


@dataclass
class Entry:
    """A job and what is known of it.

    status      the worker's latest; error: why it failed, or was not started
    seconds     that its ended workers have worked
    """

    job: Job
    digest: str
    state: JobState = JobState.WAITING
    status: WorkerStatus = field(default_factory=WorkerStatus)
    error: str = ""
    machine: str = ""
    seconds: float = 0.0
    retries: int = 0

    @property
    def left_s(self) -> float | None:
        """Seconds until it is finished, by its fraction done, else by its forecast; None:
        unknown."""
        if self.state.is_over:
            return 0.0
        spent = self.status.seconds if self.state == JobState.RUNNING else 0.0
        if self.state == JobState.RUNNING and self.status.progress > 0.05:
            return spent * (1 / self.status.progress - 1)
        forecast_s = self.job.forecast_s
        return None if forecast_s is None else max(forecast_s - spent, 0.0)


class Batch:
    """The jobs of a plan, in the order in which they can be done."""

    def __init__(self, plan: Plan) -> None:
        """Find out what is finished already. Raises StgaError where an input cannot be read."""
        self.plan = plan
        digests = job_digests(plan)
        self.entries = {job.name: Entry(job, digests[job.name]) for job in plan.jobs}
        for entry in self.entries.values():
            kept = all(self.entries[other].state.is_done for other in entry.job.after)
            record = read_record(entry.job) if kept and is_done(entry.job, entry.digest) else None
            if record is not None:
                entry.state = JobState.KEPT
                entry.status = read_status(entry.job.request_folder) or entry.status
                entry.seconds = record.seconds
                entry.machine = record.machine or entry.status.machine

    @property
    def unfinished(self) -> list[Job]:
        return [entry.job for entry in self.entries.values() if not entry.state.is_over]

    @property
    def failures(self) -> list[Entry]:
        return [e for e in self.entries.values() if e.state in (JobState.FAILED, JobState.BLOCKED)]


class BatchRun:
    """Carries out the jobs of a batch that are not finished; each that fails fails alone.

    show: called now and then; log: called with lines about what happened.
    """

    def __init__(
        self,
        batch: Batch,
        engine: Engine,
        lease: SoftFileLease,
        show: Callable[[Batch], None],
        log: Log,
    ) -> None:
        self._batch = batch
        self._engine = engine
        self._lease = lease
        self._show = show
        self._log = log
        self._entries = batch.entries
        self._shown_s = 0.0

    def run(self) -> None:
        """Raises KeyboardInterrupt after Ctrl-C when the running jobs have saved what they have,
        and StgaError where another batch has taken the folder."""
        try:
            self._work()
        except KeyboardInterrupt:
            self._log(
                "Stopping: the running jobs save what they have; Ctrl-C again leaves them to it"
            )
            self._stop()
            raise
        finally:
            self._engine.close()

    def _work(self) -> None:
        for name, entry in self._entries.items():  # workers that an earlier start left running
            if self._is_free(entry) and is_running(entry.job, entry.digest):
                entry.state = JobState.RUNNING
                self._engine.adopt(entry.job)
                self._log(f"{name}: goes on in the worker of an earlier start")
        while self._batch.unfinished:
            if self._lease.compromise is not None:
                raise StgaError(
                    f"{self._batch.plan.out}: another batch has taken this folder; this one "
                    "has ended"
                )
            begun = self._begin()
            ended = self._collect()
            self._look()
            if not (begun or ended):
                time.sleep(self._engine.interval_s)
        self._look(now=True)

    def _stop(self) -> None:
        """Ask the running jobs to stop, and wait until they have."""
        for name in self._engine.withdraw():
            self._over(self._entries[name], JobState.CANCELLED)
        running = [entry for entry in self._entries.values() if entry.state == JobState.RUNNING]
        for entry in running:
            request_cancel(entry.job.request_folder)
        while self._engine.running():
            self._collect(retry=False)
            self._look()
            time.sleep(self._engine.interval_s)
        self._collect(retry=False)
        for entry in running:
            if entry.state == JobState.RUNNING:  # Ctrl-C came between its end and the note of it
                self._over(entry, JobState.CANCELLED)
        for entry in self._entries.values():
            self._is_free(entry)

    def _is_free(self, entry: Entry) -> bool:
        """Whether a job can start; takes note of one that cannot any more."""
        if entry.state != JobState.WAITING:
            return False
        others = [self._entries[name] for name in entry.job.after]
        missing = next((o for o in others if o.state.is_over and not o.state.is_done), None)
        if missing is not None:
            was_stopped = missing.state == JobState.CANCELLED
            state = JobState.CANCELLED if was_stopped else JobState.BLOCKED
            self._over(entry, state, f"it comes after {missing.job.name}, which is not finished")
            return False
        return all(other.state.is_done for other in others)

    def _begin(self) -> bool:
        """Submit what can start; whether there was something."""
        begun = 0
        misses = 0
        for name, entry in self._entries.items():
            if misses > MAX_MISSES or begun >= MAX_BEGUN:
                break
            if not self._is_free(entry):
                continue
            if not self._engine.has_room(entry.job):
                misses += 1
                continue
            try:
                moved = prepare(entry.job, entry.digest)
                if moved is not None:
                    self._log(f"{name}: has changed; what it wrote before is in {moved}")
                self._engine.submit(entry.job)
            except StgaError as error:
                self._over(entry, JobState.FAILED, str(error))
                continue
            entry.state = JobState.RUNNING
            entry.status = WorkerStatus()
            begun += 1
        return begun > 0

    def _collect(self, retry: bool = True) -> bool:
        """Take note of what has ended; whether something has."""
        ended = self._engine.ended()
        for name, end in ended.items():
            entry = self._entries[name]
            state = end.snapshot.state
            entry.status = end.snapshot.status
            entry.machine = entry.machine or entry.status.machine
            record = read_record(entry.job)
            if record is not None:
                entry.seconds = record.seconds + entry.status.seconds
                new = replace(record, seconds=entry.seconds, machine=entry.machine)
                try:
                    write_record(entry.job, new)
                except StgaError as error:
                    self._log(f"warning: {error}")
            if retry and end.is_lost and state in _LOST and entry.retries < MAX_RETRIES:
                entry.retries += 1
                entry.state = JobState.WAITING
                self._log(f"{name}: its worker was lost; it goes on from its last checkpoint")
            else:
                outcome = _OUTCOMES.get(state, JobState.FAILED)
                self._over(entry, outcome, entry.status.error)
        return bool(ended)

    def _over(self, entry: Entry, state: JobState, error: str = "") -> None:
        """Take note of a job's end."""
        entry.state = state
        entry.error = error
        self._log(f"{entry.job.name}: {state}" + (f": {error}" if error else ""))

    def _look(self, now: bool = False) -> None:
        """Read the status of running jobs, and show the batch, at most every SHOW_INTERVAL_S."""
        if not now and time.monotonic() - self._shown_s < SHOW_INTERVAL_S:
            return
        for name, machine in self._engine.running().items():
            entry = self._entries[name]
            entry.status = read_status(entry.job.request_folder) or entry.status
            entry.machine = machine or entry.status.machine
        self._show(self._batch)
        self._shown_s = time.monotonic()


_LOST = (WorkerState.LOST, WorkerState.NONE)  # killed, or gone before it began
_OUTCOMES = {WorkerState.FINISHED: JobState.FINISHED, WorkerState.CANCELLED: JobState.CANCELLED}
