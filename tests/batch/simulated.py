"""An engine that does no work, one without workers, and batches of jobs that ask for none."""

from stga_addon.jobs.batch.folder import hold_batch
from stga_addon.jobs.batch.plan import Ended, Engine, make_plan
from stga_addon.jobs.batch.run import Batch, BatchRun
from stga_addon.jobs.perform import perform_in_folder
from stga_addon.worker.status import StatusWriter, WorkerState, inspect_worker


def finished(job):
    return WorkerState.FINISHED, ""


class SimulatedEngine(Engine):
    """Ends each job at the next question as `outcome` says; None: its worker was killed."""

    interval_s = 0.0

    def __init__(self, outcome=finished, room=1 << 30):
        self.outcome = outcome
        self.room = room
        self.submitted = []
        self.most = 0
        self.jobs = {}

    def has_room(self, job):
        return len(self.jobs) < self.room

    def submit(self, job):
        self.submitted.append(job.name)
        self.jobs[job.name] = job
        self.most = max(self.most, len(self.jobs))

    def adopt(self, job):
        self.jobs[job.name] = job

    def running(self):
        return dict.fromkeys(self.jobs, "simulated")

    def ended(self):
        jobs = self.jobs
        self.jobs = {}
        return {name: self.end(job) for name, job in jobs.items()}

    def end(self, job):
        state, error = self.outcome(job)
        if state is not None:
            StatusWriter(job.request_folder).finish(state, error)
        return Ended(inspect_worker(job.request_folder), state is None)


class InProcessEngine(SimulatedEngine):
    """Carries each job out in this process."""

    def end(self, job):
        perform_in_folder(job.request_folder, lambda text: None)
        return Ended(inspect_worker(job.request_folder), False)


def empty_jobs(base, count, again=False, **jobs):
    """A plan of `count` analyses, which write no file but their result; again: each by another job
    after it as well; and of further jobs."""
    (base / "capture").mkdir(exist_ok=True)
    for number in range(count):
        jobs[f"look-{number:05d}"] = {"request": "analyze", "capture": "capture"}
        if again:
            jobs[f"again-{number:05d}"] = {
                "request": "analyze",
                "capture": f"runs/look-{number:05d}",
            }
    return make_plan({"out": "runs", "job": jobs}, base, "plan")


def carry_out(plan, engine):
    """The batch after its end, and what was said."""
    said = []
    with hold_batch(plan.out) as lease:
        batch = Batch(plan)
        BatchRun(batch, engine, lease, lambda batch: None, said.append).run()
    return batch, said
