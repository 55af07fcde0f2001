"""The engine of this machine with real workers: results, kills, Ctrl-C, the table."""

import os
import random
import re
import signal
import subprocess
import sys
import threading

import pytest
from capture.factory import write_mesh_capture
from command_line import stga

from stga_addon.jobs.batch.engines import LocalEngine
from stga_addon.jobs.batch.plan import read_plan
from stga_addon.jobs.batch.run import Batch, JobState
from stga_addon.training.run.folder import CHECKPOINT, read_run
from stga_addon.worker.lock import lock_owner
from stga_addon.worker.status import LOCK_FILE

from .simulated import InProcessEngine, carry_out
from .tiny import ITERATIONS, check_interrupted, interrupt_batch, splats_of, tiny_plan

pytestmark = pytest.mark.slow
KILLS = int(os.environ.get("STGA_BATCH_KILLS", 2))
"""Workers that are killed, every second one with a checkpoint; 20 in the measurement of
docs/commands.md."""


def killer(jobs, kills, ended, killed, resumable):
    """Kill workers, none more than four times: in turn at a random moment, and when there is a
    checkpoint.

    resumable: those that had one.
    """
    chance = random.Random(3)
    while len(killed) < kills and not ended.wait(chance.uniform(0.2, 1.5)):
        folders = {job.name: job.request_folder for job in jobs}
        alive = {name: lock_owner(folder / LOCK_FILE) for name, folder in folders.items()}
        has_checkpoint = {
            name: (folder.parent / CHECKPOINT).exists() for name, folder in folders.items()
        }
        found = [name for name in alive if alive[name] and killed.count(name) < 4]
        found = [name for name in found if has_checkpoint[name] or len(killed) % 2 == 0]
        if found:
            name = chance.choice(found)
            try:
                os.kill(alive[name], signal.SIGKILL)
            except ProcessLookupError:
                continue
            killed.append(name)
            resumable += [name] if has_checkpoint[name] else []


@pytest.mark.nightly
def test_killed_workers_resume_to_the_same_bits(tmp_path, trained_here, monkeypatch):
    """Catches a job that a kill damages, loses or changes, and one that is not tried again."""
    monkeypatch.setenv("STGA_CHECKPOINT_S", "0.3")
    seeds = max(1, KILLS // 3)
    iterations = max(ITERATIONS, 80 * KILLS)
    whole = trained_here(seeds, iterations)
    plan = tiny_plan(tmp_path, seeds, iterations)
    ended = threading.Event()
    killed = []
    resumable = []
    thread = threading.Thread(target=killer, args=(plan.jobs, KILLS, ended, killed, resumable))
    thread.start()
    try:
        batch, _ = carry_out(plan, LocalEngine(2, 8.0, sys.executable))
    finally:
        ended.set()
        thread.join()
    print(f"{len(killed)} killed, {len(resumable)} of them with a checkpoint")
    assert len(killed) >= KILLS // 2
    assert resumable
    assert {entry.state for entry in batch.entries.values()} == {JobState.FINISHED}
    for seed in range(seeds):
        name = f"train-seed{seed}"
        assert splats_of(plan, name) == splats_of(whole, name)
        qualities = [(p.out / name / "quality_val.json").read_text() for p in (plan, whole)]
        assert qualities[0] == qualities[1]


def test_command(tmp_path, capsys):
    """Catches a failure nobody sees, Ctrl-C that loses work, and a forecast that a plan gives but
    nobody is told."""
    tiny_plan(tmp_path)
    code, output = interrupt_batch(tmp_path)
    check_interrupted(tmp_path, code, output)
    assert re.search(r"\ntrain-bad +Train +failed ", output)
    assert "\n0 of 2 jobs finished, 1 failed, 1 stopped\n" in output
    assert stga("batch", tmp_path / "plan.toml", "--dry-run") == 0
    printed = capsys.readouterr().out
    assert re.search(r"train-good +Train +1 thread, 0\.5 GB +6 s", printed)
    assert "2 jobs, 2 to do; 12 s of work" in printed


def test_captures_of_the_command(tmp_path, capsys, monkeypatch):
    """Catches options that are forgotten for captures, or silently ignored for a plan."""
    monkeypatch.setattr("stga_addon.jobs.batch.engines.make_engine", lambda *_: InProcessEngine())
    tiny_plan(tmp_path)
    capture = str(tmp_path / "capture")
    out = str(tmp_path / "out")
    options = "--iterations 2 --device cpu --threads 1 --principal-point opencv --seed 5"
    assert stga("batch", capture, "--out", out, options) == 0
    assert "1 of 1 jobs finished" in capsys.readouterr().out
    run = read_run(tmp_path / "out/train-capture")
    found = run.principal_point, run.settings.iterations, run.settings.seed, run.device
    assert found == ("opencv", 2, 5, "cpu")


def test_commands_carry_out_the_batch(tmp_path, capsys):
    """Catches commands that a shell elsewhere cannot run, in another order, or of finished jobs."""
    write_mesh_capture(tmp_path / "a capture")
    look = '[job.{}]\nrequest = "select"\ncapture = "a capture"\nafter = {}\n'
    plan = tmp_path / "plan.toml"
    plan.write_text('out = "runs"\n' + look.format("again", ["look"]) + look.format("look", []))
    assert stga("batch", plan, "--commands") == 0
    first, second = capsys.readouterr().out.splitlines()
    assert second.endswith("  # after look")
    subprocess.run(["sh", "-c", first], check=True, cwd="/")
    assert stga("batch", plan, "--commands") == 0
    (left,) = capsys.readouterr().out.splitlines()
    assert left == second.partition("  #")[0]
    subprocess.run(["sh", "-c", second], check=True, cwd="/")
    assert not Batch(read_plan(plan)).unfinished
