"""The SLURM engine on a cluster of two nodes on this host."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from stga_addon.errors import StgaError
from stga_addon.jobs.batch import slurm
from stga_addon.jobs.batch.engines import make_engine
from stga_addon.jobs.batch.run import JobState
from stga_addon.jobs.batch.slurm import SlurmEngine
from stga_addon.worker.lock import lock_owner
from stga_addon.worker.status import LOCK_FILE, StatusWriter, WorkerState

from .simulated import carry_out, empty_jobs
from .slurm_cluster import Cluster, running_cluster
from .tiny import check_interrupted, interrupt_batch, splats_of, tiny_plan

pytest.importorskip("torch")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with running_cluster(tmp_path_factory.mktemp("slurm")) as found:
        yield found


@pytest.fixture
def on_cluster(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> Cluster:
    for name in ("PATH", "SLURM_CONF"):
        monkeypatch.setenv(name, cluster.variables[name])
    monkeypatch.setattr(SlurmEngine, "interval_s", 0.5)
    return cluster


@pytest.mark.needs("slurm")
def test_same_results_through_slurm(on_cluster, tmp_path, trained_here):
    """Catches jobs before those they come after, other results, and a killed worker's job lost."""
    there = tiny_plan(tmp_path)
    machines: set[str] = set()
    killed: list[int] = []

    class Watched(SlurmEngine):
        def ended(self):  # type: ignore[no-untyped-def]
            found = super().ended()
            machines.update(self.running().values())
            folder = there.out / "train-seed0/job"
            owner = lock_owner(folder / LOCK_FILE)
            if owner and not killed and (there.out / "train-seed0/metrics.jsonl").exists():
                os.kill(owner, signal.SIGKILL)
                killed.append(owner)
            return found

    batch, _ = carry_out(there, Watched())
    assert {entry.state for entry in batch.entries.values()} == {JobState.FINISHED}, batch.failures
    assert killed
    assert machines == {"one", "two"}
    for name in ("train-seed0", "train-seed1"):
        assert splats_of(there, name) == splats_of(trained_here(), name)


@pytest.mark.nightly
@pytest.mark.needs("slurm")
def test_jobs_of_a_dead_node_resume_elsewhere(on_cluster, tmp_path, trained_here, monkeypatch):
    """Catches a job lost with its machine, or another one when resumed on the next."""
    monkeypatch.setenv("STGA_CHECKPOINT_S", "0.3")
    there = tiny_plan(tmp_path)
    killed: list[str] = []

    class Watched(SlurmEngine):
        def ended(self):  # type: ignore[no-untyped-def]
            found = super().ended()
            node = self.running().get("train-seed0")
            if node and not killed and (there.out / "train-seed0/checkpoint.npz").exists():
                on_cluster.kill_node(node)
                killed.append(node)
            if killed:
                on_cluster.start_delayed()
            return found

    try:
        batch, _ = carry_out(there, Watched())
    finally:
        for node in killed:
            on_cluster.start_node(node)
    assert {entry.state for entry in batch.entries.values()} == {JobState.FINISHED}, batch.failures
    assert killed
    for name in ("train-seed0", "train-seed1"):
        assert splats_of(there, name) == splats_of(trained_here(), name)


@pytest.mark.nightly
@pytest.mark.needs("slurm")
def test_ctrl_c_through_slurm(on_cluster: Cluster, tmp_path: Path) -> None:
    """Catches Ctrl-C that leaves trainings to the queue, or takes them away before they saved."""
    tiny_plan(tmp_path)
    check_interrupted(tmp_path, *interrupt_batch(tmp_path, "--engine", "slurm"))


@pytest.mark.needs("slurm")
def test_what_slurm_refuses_is_a_sentence(on_cluster: Cluster, tmp_path: Path) -> None:
    """Catches a batch that waits for ever for jobs that no machine of the cluster can take."""
    huge = {"resources": {"memory_gb": 1e6, "threads": 1}}
    plan = empty_jobs(tmp_path, 1, huge={"request": "analyze", "capture": "capture", **huge})
    batch, _ = carry_out(plan, SlurmEngine())
    assert batch.entries["huge"].state == JobState.FAILED
    assert "sbatch: " in batch.entries["huge"].error


def stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, programs: dict[str, str]) -> None:
    """Programs of the names of SLURM's: what each does, in shell."""
    for name, text in programs.items():
        (folder / name).write_text(f"#!/bin/sh\n{text}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")


def test_what_waits_in_the_queue_is_submitted_once(tmp_path, monkeypatch):
    """Catches a batch that ends where squeue fails once, and jobs submitted again."""
    queue = tmp_path / "queue"
    down = tmp_path / "down"
    calls = tmp_path / "calls"
    programs = {
        "sbatch": f'echo "$@" >>{calls}; n=$(wc -l <{calls}); '
        f'for i in 0 1 2; do echo "${{n}}_$i|PENDING|" >>{queue}; done; echo $n',
        "squeue": f"if [ -e {down} ]; then echo unreachable >&2; exit 1; fi; cat {queue}",
        "scancel": "exit 1",
    }
    stand_in(tmp_path, monkeypatch, programs)
    monkeypatch.setattr(SlurmEngine, "interval_s", 0.01)
    monkeypatch.setattr(slurm, "GRACE_S", 0.0)
    asked = 0

    class Killed(SlurmEngine):
        def ended(self):  # type: ignore[no-untyped-def]
            nonlocal asked
            asked += 1
            (down.touch if asked < 3 else down.unlink)() if asked < 4 else None
            if asked == 5:
                raise MemoryError
            return super().ended()

    class Emptied(SlurmEngine):
        def ended(self):  # type: ignore[no-untyped-def]
            if self._jobs:
                assert super().ended() == {}
            for job in plan.jobs:
                StatusWriter(job.request_folder).finish(WorkerState.FINISHED)
            queue.write_text("")
            return super().ended()

    plan = empty_jobs(tmp_path, 3)
    with pytest.raises(MemoryError):
        carry_out(plan, Killed())
    batch, _ = carry_out(plan, Emptied())
    assert {entry.state for entry in batch.entries.values()} == {JobState.FINISHED}
    assert len(calls.read_text().splitlines()) == 1
    down.touch()
    monkeypatch.setattr(slurm, "MAX_SILENCE_S", -1.0)
    with pytest.raises(StgaError, match="squeue: unreachable"):
        SlurmEngine().ended()


def test_arrays_wait_for_earlier_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an array that waits for itself, and a job in none, in two, or in too large a one."""
    calls = tmp_path / "calls"
    programs = {"sbatch": f'echo "$@" >>{calls}; wc -l <{calls}', "squeue": "", "scancel": ""}
    stand_in(tmp_path, monkeypatch, programs)
    monkeypatch.setattr(slurm, "MAX_ARRAY", 2)
    large = {"request": "analyze", "capture": "runs/again-00002", "resources": {"memory_gb": 7}}
    plan = empty_jobs(tmp_path, 3, again=True, last=large)
    SlurmEngine().submit(plan.jobs)
    lines = calls.read_text().splitlines()
    assert [int(line.split("--array=0-")[1].split()[0]) + 1 for line in lines] == [2, 1, 2, 1, 1]
    waits = [line.partition("afterany:")[2].split(" ")[0] for line in lines]
    assert waits == ["", "", "1", "2", "4"]
    assert ["--mem=7000M" in line for line in lines] == [False] * 4 + [True]
    scripts = "".join(path.read_text() for path in (plan.out / "slurm").glob("*.sh"))
    assert [scripts.count(f"{job.request_folder} ") for job in plan.jobs] == [1] * 7


def test_without_slurm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a traceback where SLURM is not installed, and an address that is silently ignored."""
    monkeypatch.setattr(slurm.shutil, "which", lambda name: None)
    with pytest.raises(StgaError, match="--engine slurm: the program sbatch was not found"):
        make_engine("slurm")
    sentence = "--address: is that of a Ray cluster; expected --engine ray, got slurm"
    with pytest.raises(StgaError, match=sentence):
        make_engine("slurm", "host:1")
