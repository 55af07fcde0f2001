"""A batch of trainings that take a moment each, and one that is interrupted."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

from capture.factory import write_mesh_capture

from stga_addon.avatar.file import read_avatar
from stga_addon.files import read_npz
from stga_addon.jobs.batch.plan import make_plan
from stga_addon.training.run.folder import AVATAR
from stga_addon.worker.status import read_status

ROOT = Path(__file__).resolve().parents[2]

ITERATIONS = 400
"""Some seconds of training, so that workers and machines can be killed between checkpoints."""
RAY_SETTINGS = {
    "worker_niceness": "0",
    "health_check_initial_delay_ms": "1000",
    "health_check_period_ms": "1000",
    "health_check_failure_threshold": "3",
    "health_check_timeout_ms": "10000",
}
"""Tasks have the priority of the tests beside them (Ray's own is 15 lower, and takes minutes then);
a killed node is noticed after 3 s, and a node that is only slow has 10 s to answer."""
SETTINGS = {"strategy": "selective", "hull_points": False}


def tiny_plan(base, seeds=2, iterations=ITERATIONS):
    """Trainings of one capture with several seeds, and an evaluation after each."""
    if not (base / "capture").exists():
        write_mesh_capture(base / "capture", (0, 1, 3, 4), range(4))
    train = {"request": "train", "capture": "capture", "principal_point": "opencv"}
    train |= {"device": "cpu", "minutes": 0.1}
    jobs = {}
    for seed in range(seeds):
        settings = {**SETTINGS, "iterations": iterations, "seed": seed}
        jobs[f"train-seed{seed}"] = {**train, "settings": settings}
        look = {"request": "evaluate", "run": f"runs/train-seed{seed}", "minutes": 0.1}
        jobs[f"evaluate-seed{seed}"] = look
    resources = {"threads": 1, "memory_gb": 0.5}
    return make_plan({"out": "runs", "resources": resources, "job": jobs}, base, "plan")


def splats_of(plan, name):
    """The arrays of a run's avatar as bytes; without its header, whose figures of the light depend
    in their last bits on the threads of the linear algebra."""
    path = plan.out / name / AVATAR
    read_avatar(path)
    return {key: array.tobytes() for key, array in read_npz(path).items() if key != "header"}


def ray_variables():
    """This process's variables, but of Ray's only RAY_SETTINGS."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    return kept | {f"RAY_{name}": value for name, value in RAY_SETTINGS.items()}


def interrupt_batch(base, *options):
    """Exit code and output of `stga batch` on `base`/plan.toml after Ctrl-C, which came when its
    job `train-good` was training and its job `train-bad` had failed."""
    (base / "bad").mkdir()
    (base / "plan.toml").write_text(
        'out = "runs"\n[resources]\nthreads = 1\nmemory_gb = 0.5\n'
        + "".join(
            f'[job.train-{name}]\nrequest = "train"\ndevice = "cpu"\nprincipal_point = '
            f'"opencv"\nminutes = 0.1\n'
            f'capture = "{capture}"\n'
            'settings = { strategy = "selective", iterations = 100000, hull_points = false }\n'
            for name, capture in (("bad", "bad"), ("good", "capture"))
        )
    )
    command = [sys.executable, "-m", "stga_addon", "batch", str(base / "plan.toml"), *options]
    started = subprocess.Popen(
        command,
        cwd=ROOT,
        env=ray_variables(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        status, failed = (read_status(base / f"runs/train-{name}/job") for name in ("good", "bad"))
        if status and status.message == "Training" and status.progress and failed and failed.error:
            break
        time.sleep(0.2)
    time.sleep(1)
    started.send_signal(signal.SIGINT)
    output, _ = started.communicate(timeout=120)
    return started.returncode, output


def check_interrupted(base, code, output):
    """What `interrupt_batch` has to leave: one job's failure, and the other's checkpoint."""
    assert code == 130, output
    assert "train-good: stopped" in output
    assert re.search(r"train-bad: failed: .*bad", output)
    run = base / "runs/train-good"
    before = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])["iteration"]
    assert (run / "checkpoint.npz").exists()
    assert 0 < before < 100000
