"""The Ray engine on a cluster that is started here."""

import os
import secrets
import sys

import pytest
from blender.zips import output_of
from capture.factory import write_mesh_capture
from refusal import refusal

from stga_addon.jobs.batch import ray as ray_engine
from stga_addon.jobs.batch.engines import make_engine

from .tiny import (
    ITERATIONS,
    ROOT,
    check_interrupted,
    interrupt_batch,
    ray_variables,
    splats_of,
    tiny_plan,
)

BATCH = """
import os, subprocess, sys
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/tests"]
from pathlib import Path
from batch.simulated import carry_out
from stga_addon.jobs.batch.engines import make_engine
from stga_addon.jobs.batch.plan import make_plan

engine = make_engine("ray")
assert os.environ["RAY_AUTH_MODE"] == "token"
import ray
address = ray.get_runtime_context().gcs_address
client = f"GcsClient(address={address!r})"
look = f"from ray._raylet import GcsClient; print({client}.get_all_node_info(timeout=60))"
for token, code in ((os.environ["RAY_AUTH_TOKEN"], 0), ("0" * 64, 1)):
    variables = {**os.environ, "RAY_AUTH_TOKEN": token}
    asked = subprocess.run([sys.executable, "-c", look], env=variables, capture_output=True,
        text=True, timeout=120)
    assert asked.returncode == code, asked
    assert ("InvalidAuthToken" in asked.stderr) == bool(code), asked
look = {"request": "select", "capture": "capture"}
batch, _ = carry_out(make_plan({"out": "runs", "job": {"look": look}}, Path(sys.argv[2]), "plan"),
    engine)
print(sorted((entry.job.name, str(entry.state), entry.error) for entry in batch.entries.values()))
"""
NODES = """
import random, sys
from concurrent.futures import ThreadPoolExecutor, wait
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/tests"]
from pathlib import Path
from ray.cluster_utils import Cluster
from batch.simulated import carry_out
from batch.tiny import tiny_plan
from stga_addon.jobs.batch.engines import make_engine
from stga_addon.training.run.folder import CHECKPOINT
from stga_addon.worker.lock import is_locked
from stga_addon.worker.status import LOCK_FILE

kills, seeds = int(sys.argv[3]), int(sys.argv[4])
size = {"num_cpus": 1, "object_store_memory": 80_000_000}
cluster = Cluster(initialize_head=True, head_node_args={**size, "num_cpus": 0})
# each of them with work, so that a kill hits
nodes = [cluster.add_node(**size) for _ in range(min(2, seeds))]
plan = tiny_plan(Path(sys.argv[2]), seeds, int(sys.argv[5]))
chance, killed, resumable, engine = random.Random(5), 0, 0, make_engine("ray", cluster.address)
with ThreadPoolExecutor(1) as pool:
    running = pool.submit(carry_out, plan, engine)
    # In this thread: a node sets a signal handler, which only the main thread can.
    while killed < kills and not wait([running], chance.uniform(0.2, 1)).done:
        folders = [job.request_folder for job in plan.jobs]
        begun = [folder for folder in folders if is_locked(folder / LOCK_FILE)]
        with_checkpoint = [folder for folder in begun if (folder.parent / CHECKPOINT).exists()]
        if with_checkpoint if killed % 2 else begun:
            cluster.remove_node(nodes.pop(0), allow_graceful=False)
            killed, resumable = killed + 1, resumable + bool(with_checkpoint)
            nodes.append(cluster.add_node(**size))
    batch, said = running.result()
cluster.shutdown()
print(killed, "nodes killed,", resumable, "of them when a job had a checkpoint", flush=True)
print(sorted((entry.job.name, str(entry.state), entry.error) for entry in batch.entries.values()))
"""
KILLS = int(os.environ.get("STGA_BATCH_NODE_KILLS", 2))
"""Nodes that are killed, every second one when a job has a checkpoint; 6 in the measurement of
docs/commands.md."""


def run_script(script, *arguments, **variables):
    """Lines that a script prints in a process of its own, which Ray leaves its settings to."""
    command = [sys.executable, "-c", script, ROOT, *arguments]
    environment = {**ray_variables(), **variables}
    return output_of(command, env=environment, timeout=1200, cwd=ROOT).splitlines()


@pytest.mark.nightly
def test_jobs_of_killed_nodes_resume_elsewhere(tmp_path, trained_here):
    """Catches a token that cannot be used, jobs lost or changed, and two workers on one."""
    seeds = max(1, KILLS // 2)
    iterations = max(ITERATIONS, 200 * KILLS)
    variables = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    variables["STGA_CHECKPOINT_S"] = "0.3"
    killed, states = run_script(NODES, tmp_path, KILLS, seeds, iterations, **variables)[-2:]
    names = [f"{table}-seed{n}" for table in ("evaluate", "train") for n in range(seeds)]
    assert states == str([(name, "finished", "") for name in sorted(names)])
    print(killed)
    assert int(killed.split()[0]) >= KILLS // 2
    assert int(killed.split()[3]) > 0
    here = trained_here(seeds, iterations)
    there = tiny_plan(tmp_path, seeds, iterations)
    for seed in range(seeds):
        assert splats_of(there, f"train-seed{seed}") == splats_of(here, f"train-seed{seed}")


@pytest.mark.nightly
def test_a_cluster_of_this_machine_is_its_users(tmp_path):
    """Catches a cluster that anyone on this machine may use, and jobs not carried out there."""
    write_mesh_capture(tmp_path / "capture")
    assert run_script(BATCH, tmp_path)[-1] == str([("look", "finished", "")])


@pytest.mark.nightly
def test_ctrl_c_through_ray(tmp_path):
    """Catches Ctrl-C that tasks do not hear, or that takes the cluster before they have saved."""
    tiny_plan(tmp_path)
    check_interrupted(tmp_path, *interrupt_batch(tmp_path, "--engine", "ray"))


def test_without_ray(monkeypatch):
    """Catches a traceback where Ray is not installed, and an address that is silently ignored."""
    monkeypatch.setattr(ray_engine, "find_spec", lambda name: None)
    with refusal("--engine ray: the package ray is not installed"):
        make_engine("ray")
    with refusal(r"--address: .*expected --engine ray, got local"):
        make_engine("local", "host:1")
