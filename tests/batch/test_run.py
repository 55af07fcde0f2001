"""Batches on an engine that does no work: order, failures, kills, and a second start."""

import errno
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest
from blender.zips import output_of
from refusal import refusal

from stga_addon.errors import StgaError
from stga_addon.jobs.batch import engines
from stga_addon.jobs.batch.engines import LocalEngine
from stga_addon.jobs.batch.folder import LOCK, hold_batch, is_done, prepare, read_record
from stga_addon.jobs.batch.plan import Ended, Job, Resources, make_plan
from stga_addon.jobs.batch.run import MAX_RETRIES, Batch, JobState
from stga_addon.jobs.batch.table import ended_lines
from stga_addon.jobs.blender import RenderBlend
from stga_addon.jobs.convert_motion import ConvertMotion
from stga_addon.progress import Progress
from stga_addon.training.run.folder import Run, write_run
from stga_addon.training.run.metrics_log import append_metrics
from stga_addon.training.settings import TrainingSettings
from stga_addon.worker import lock, status
from stga_addon.worker.status import StatusWriter, WorkerState, inspect_worker

from .simulated import SimulatedEngine, carry_out, empty_jobs

AFTER = [f"again-{number:05d}" for number in range(3)]
LAST = {"request": "analyze", "capture": "capture", "after": AFTER}


def states(batch):
    return {name: entry.state for name, entry in batch.entries.items()}


def test_second_start_does_only_what_is_left(tmp_path):
    """Catches work repeated, and work not done though its input or result has changed."""
    plan = empty_jobs(tmp_path, 3, again=True, last=LAST)
    engine = SimulatedEngine(room=2)
    batch, _ = carry_out(plan, engine)
    assert set(states(batch).values()) == {JobState.FINISHED}
    assert engine.submitted.index("last") == len(plan.jobs) - 1
    assert engine.most == 2
    second = SimulatedEngine()
    batch, _ = carry_out(plan, second)
    assert second.submitted == []
    assert set(states(batch).values()) == {JobState.KEPT}
    (tmp_path / "runs/look-00001/job/status.json").unlink()
    third = SimulatedEngine()
    carry_out(plan, third)
    assert third.submitted == ["look-00001", "again-00001", "last"]
    (tmp_path / "capture/new.png").touch()
    fourth = SimulatedEngine()
    _, said = carry_out(plan, fourth)
    assert len(fourth.submitted) == len(plan.jobs)
    moved = tmp_path / "runs/replaced/look-00001"
    assert f"look-00001: has changed; what it wrote before is in {moved}" in said
    assert (moved / "job/request.json").exists()


def test_a_batch_that_writes_into_what_it_reads(tmp_path):
    """Catches jobs that are never finished, because what they write changes what they read."""

    def outcome(job):
        if isinstance(job.request, ConvertMotion):
            job.request.output.touch()
        return WorkerState.FINISHED, ""

    (tmp_path / "capture").mkdir()
    look = {"request": "analyze", "capture": "capture"}
    face = {"request": "convert-motion", "source": "capture"}
    face["output"] = str(tmp_path / "capture/face.csv")
    plan = make_plan({"out": "capture/runs", "job": {"look": look, "face": face}}, tmp_path, "plan")
    for submitted in (["look", "face"], [], ["look", "face"]):
        if not submitted:
            assert (tmp_path / "capture/face.csv").exists()
        elif (tmp_path / "capture/runs").exists():
            (tmp_path / "capture/new.png").touch()
        engine = SimulatedEngine(outcome)
        carry_out(plan, engine)
        assert engine.submitted == submitted


def test_a_frame_that_is_gone_is_rendered_again(tmp_path):
    """Catches a picture that was removed to be rendered anew, and counts as finished."""

    def outcome(job):
        assert isinstance(job.request, RenderBlend)
        for picture in job.request.pictures.values():
            picture.touch()
        return WorkerState.FINISHED, ""

    (tmp_path / "shot.blend").touch()
    both = ["film-1", "film-3"]
    film = {"request": "render-blend", "blend": "shot.blend"}
    jobs = {"film-1": {**film, "frames": [1, 2]}, "film-3": {**film, "frames": [3, 4]}}
    plan = make_plan({"out": "runs", "job": jobs}, tmp_path, "plan")
    for gone, submitted in ((None, both), ("film-3/000004.png", both[1:])):
        if gone is not None:
            (plan.out / gone).unlink()
        engine = SimulatedEngine(outcome)
        carry_out(plan, engine)
        assert engine.submitted == submitted


def test_a_failed_job_fails_alone(tmp_path):
    """Catches a failure that stops other jobs, or is passed on as if the next had failed itself."""

    def outcome(job):
        failed = job.name == "look-00001"
        return (WorkerState.FAILED, "capture: is empty") if failed else (WorkerState.FINISHED, "")

    plan = empty_jobs(tmp_path, 3, again=True, last=LAST)
    batch, said = carry_out(plan, SimulatedEngine(outcome))
    found = states(batch)
    assert found["look-00001"] == JobState.FAILED
    assert batch.entries["look-00001"].error == "capture: is empty"
    assert found["again-00001"] == JobState.BLOCKED
    assert batch.entries["again-00001"].error == "it comes after look-00001, which is not finished"
    assert Counter(found.values())[JobState.FINISHED] == 4
    assert "look-00001: failed: capture: is empty" in said
    engine = SimulatedEngine()
    batch, _ = carry_out(plan, engine)
    assert set(engine.submitted) >= {"look-00001", "again-00001"}
    assert "look-00000" not in engine.submitted
    assert all(state.is_done for state in states(batch).values())


def test_a_lost_worker_is_replaced(tmp_path):
    """Catches a batch that ends because a machine died, and one that tries a job for ever."""
    deaths = Counter({"look-00000": 2, "look-00001": 99})

    def outcome(job):
        deaths[job.name] -= 1
        return (None, "") if deaths[job.name] >= 0 else (WorkerState.FINISHED, "")

    engine = SimulatedEngine(outcome)
    batch, _ = carry_out(empty_jobs(tmp_path, 3), engine)
    assert states(batch)["look-00000"] == JobState.FINISHED
    assert states(batch)["look-00001"] == JobState.FAILED
    assert "Worker exited unexpectedly" in batch.entries["look-00001"].error
    tries = Counter(engine.submitted)
    assert tries == {"look-00000": 3, "look-00001": 1 + MAX_RETRIES, "look-00002": 1}


def test_waiting_in_a_queue_is_no_work(tmp_path, monkeypatch):
    """Catches times and forecasts that grow with a cluster's queue or a batch's pauses."""
    queue_s = 800.0
    work_s = 200.0
    now = 0.0
    monkeypatch.setattr(status, "time", SimpleNamespace(monotonic=lambda: now))  # of the workers

    class Queued(SimulatedEngine):
        def running(self):
            return {}

        def end(self, job):
            nonlocal now
            now += queue_s
            writer = StatusWriter(job.request_folder)
            now += work_s
            writer.report(Progress(0.5, "Working"))
            writer.finish(WorkerState.FINISHED)
            return Ended(inspect_worker(job.request_folder))

    batch, _ = carry_out(empty_jobs(tmp_path, 1), Queued())
    (entry,) = batch.entries.values()
    record = read_record(entry.job)
    assert now == queue_s + work_s
    assert record.seconds == entry.seconds == work_s


def test_the_table_shows_the_avatar_that_is_kept(tmp_path):
    """Catches figures of an earlier state for a continuation, which keeps its latest, those of
    heads fitted to held-out images, and a failure whose reason nobody sees."""
    lines = [(25.0, 0.1, {}), (24.0, 0.2, {"psnr_fitted_heads": 27.25})]
    for name, strategy in (("whole", "global"), ("refined", "refine")):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        settings = TrainingSettings(iterations=2, strategy=strategy)
        write_run(folder, Run(tmp_path, None, "vhap", settings))
        for number, (psnr, detail, more) in enumerate(lines):
            line = {"iteration": number, "seconds": float(number), "splats": 10 + number}
            line |= {"evaluation_s": 0.1, "wall_s": 1.0, "psnr": psnr, "ssim": 0.9}
            append_metrics(folder, {**line, "detail_difference": detail, **more})
    train = {"request": "train", "capture": "capture", "settings": {"iterations": 2}}
    jobs = dict.fromkeys(("whole", "refined", "bad"), train)
    (tmp_path / "capture").mkdir()
    batch = Batch(make_plan({"out": "runs", "job": jobs}, tmp_path, "plan"))
    for entry in batch.entries.values():
        entry.state = JobState.FINISHED
    (tmp_path / "runs/bad").mkdir()
    batch.entries["bad"].state = JobState.FAILED
    batch.entries["bad"].error = "capture: is empty"
    lines = ended_lines(batch)
    rows = {line.split()[0]: line.split() for line in lines[1:4]}
    assert rows["whole"] == ["whole", "Train", "finished", "25.00", "dB", "10"]
    assert rows["refined"] == ["refined", "Train", "finished", "24.00", "dB", "11"]
    assert rows["bad"] == ["bad", "Train", "failed"]
    assert lines[-2:] == ["bad: capture: is empty", "2 of 3 jobs finished, 1 failed"]


def test_ctrl_c_leaves_the_rest(tmp_path):
    """Catches an interrupted batch that starts further jobs, or forgets finished ones."""
    plan = empty_jobs(tmp_path, 4)

    def outcome(job):
        if job.name == "look-00001":
            raise KeyboardInterrupt
        return WorkerState.FINISHED, ""

    engine = SimulatedEngine(outcome, room=1)
    with pytest.raises(KeyboardInterrupt):
        carry_out(plan, engine)
    assert engine.submitted == ["look-00000", "look-00001"]
    second = SimulatedEngine()
    carry_out(plan, second)
    assert second.submitted == ["look-00001", "look-00002", "look-00003"]


def test_files_of_others_stay(tmp_path):
    """Catches a batch that moves what no job wrote, or starts the jobs after it."""
    plan = empty_jobs(tmp_path, 2, again=True)
    own = tmp_path / "runs/look-00000/run.json"
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    engine = SimulatedEngine()
    batch, _ = carry_out(plan, engine)
    assert engine.submitted == ["look-00001", "again-00001"]
    assert states(batch)["again-00000"] == JobState.BLOCKED
    assert "holds files that no job of a batch wrote" in batch.entries["look-00000"].error
    assert states(batch)["again-00001"] == JobState.FINISHED
    assert own.read_text() == "mine"


def test_a_job_that_an_engine_refuses_fails_alone(tmp_path):
    """Catches a batch that ends, or waits for ever, where a worker cannot be started."""

    class Refusing(SimulatedEngine):
        def submit(self, job):
            if job.name == "look-00000":
                raise StgaError("python: cannot be run")
            super().submit(job)

    batch, _ = carry_out(empty_jobs(tmp_path, 2, again=True), Refusing())
    assert batch.entries["look-00000"].error == "python: cannot be run"
    assert states(batch)["again-00000"] == JobState.BLOCKED
    assert states(batch)["again-00001"] == JobState.FINISHED


def test_a_damaged_record_is_no_result(tmp_path):
    """Catches a traceback, or a job that counts as finished, where its record is cut off; and one
    that an earlier version finished and that is done again."""
    plan = empty_jobs(tmp_path, 1)
    carry_out(plan, SimulatedEngine())
    record = tmp_path / "runs/look-00000/job/job.json"
    digest = json.loads(record.read_text())["digest"]
    assert is_done(plan.jobs[0], digest)
    earlier = {**json.loads(record.read_text()), "forecast_s": 4.5}
    record.write_text(json.dumps(earlier))
    assert is_done(plan.jobs[0], digest)
    record.write_text(record.read_text()[:20])
    assert not is_done(plan.jobs[0], digest)
    carry_out(plan, SimulatedEngine())
    assert is_done(plan.jobs[0], digest)


def test_room_on_this_machine(tmp_path):
    """Catches more workers than there are processors or memory, and one that never fits."""
    engine = LocalEngine(cores=4, memory_gb=8.0)

    def job(name, **needs):
        found = empty_jobs(tmp_path, 1).jobs[0]
        resources = Resources(**{"threads": 1, **needs})
        return Job(name, found.request, tmp_path / name, resources=resources)

    assert engine.has_room(job("huge", threads=64, memory_gb=100.0))
    engine.adopt(job("a", threads=2, memory_gb=3.0, gpu=True))
    assert engine.has_room(job("b", threads=2, memory_gb=5.0))
    assert not engine.has_room(job("b", threads=3))
    assert not engine.has_room(job("b", memory_gb=5.1))
    assert not engine.has_room(job("b", gpu=True))


@pytest.mark.parametrize(
    ("windows", "ending", "is_lost"),
    [
        (False, "kill -9 $$", True),
        (False, "exit 1", False),
        (True, "exit 1", True),
        (True, "exit 2", False),
    ],
)
def test_a_killed_worker_is_told_from_a_mistake(tmp_path, monkeypatch, windows, ending, is_lost):
    """Catches a killed worker not tried again on Windows, where a kill is an exit status."""
    monkeypatch.setattr(engines, "IS_WINDOWS", windows)
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\n{ending}\n")
    python.chmod(0o755)
    (job,) = empty_jobs(tmp_path, 1).jobs
    prepare(job, "digest")
    engine = LocalEngine(1, 1.0, str(python))
    engine.submit(job)
    while not (ended := engine.ended()):
        time.sleep(0.01)
    assert ended[job.name].snapshot.state == WorkerState.LOST
    assert ended[job.name].is_lost == is_lost


# The lease


LEASE = f"{LOCK}.lease"


def _hold(folder, held):
    with hold_batch(Path(folder)):
        held.set()
        time.sleep(120)


@pytest.mark.parametrize("locks", ["work", "fail"])
def test_two_batches_cannot_take_one_folder(tmp_path, locks, monkeypatch):
    """Catches two batches in one folder, also where the storage knows no file locks."""
    if locks == "fail":

        def no_lock(path):
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr(lock, "_hold_file_lock", no_lock)
    monkeypatch.setattr(lock, "BEAT_S", 0.1)
    monkeypatch.setattr(lock, "EXPIRY_S", 4.0)
    context = multiprocessing.get_context("fork")
    held = context.Event()
    other = context.Process(target=_hold, args=(str(tmp_path), held))
    other.start()
    try:
        assert held.wait(30)
        expected = r"another batch is working in this folder \(process \d+"
        with refusal(expected), hold_batch(tmp_path):
            pass
        other.kill()  # which leaves the lease behind
        other.join()
        assert (tmp_path / LEASE).exists()
        with hold_batch(tmp_path) as lease:
            assert lease.compromise is None
    finally:
        other.kill()
        other.join()
    assert not (tmp_path / LEASE).exists()


def test_a_lease_that_was_taken_is_noticed(tmp_path, monkeypatch):
    """Catches a batch that goes on in a folder which another took while it was suspended."""
    monkeypatch.setattr(lock, "BEAT_S", 0.05)
    plan = empty_jobs(tmp_path, 1)

    def outcome(job):
        os.replace(plan.out / LEASE, plan.out / "suspended")
        (plan.out / LEASE).touch()
        time.sleep(0.5)
        return None, ""

    with refusal("another batch has taken this folder"):
        carry_out(plan, SimulatedEngine(outcome))


COST = """
import re, sys, tempfile, time
from pathlib import Path
from batch.simulated import SimulatedEngine, carry_out, empty_jobs

def cost(count):
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        batch, _ = carry_out(empty_jobs(Path(folder), count), SimulatedEngine())
    assert {entry.state.value for entry in batch.entries.values()} == {"finished"}
    peak_kb = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
    return (time.process_time() - begin) / count, int(peak_kb)

cost(20)  # loads what is loaded late
for count in map(int, sys.argv[1:]):
    print(*cost(count))
"""
JOBS = int(os.environ.get("STGA_BATCH_JOBS", 1000))
"""Jobs of the larger batch; a measurement had 10,000."""


@pytest.mark.slow
def test_a_job_costs_the_same_in_a_large_batch(tmp_path):
    """Catches time or memory that grows faster than the number of jobs, in a process of its own."""
    if not Path("/proc/self/status").exists():
        pytest.skip("peak memory of a process is read from Linux's /proc")
    tests = Path(__file__).resolve().parents[1]
    few = JOBS // 8
    path = os.pathsep.join([str(tests.parent), str(tests)])
    environment = os.environ | {"PYTHONPATH": path, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", COST, str(few), str(JOBS)]
    printed = output_of(command, env=environment)
    small_s, small_kb, large_s, large_kb = map(float, printed.split())
    print(f"{JOBS} jobs: {JOBS * large_s:.1f} s of processor time, {large_kb / 1024:.0f} MB")
    assert large_s < 1.8 * small_s
    assert large_kb - small_kb < 30 * (JOBS - few)
