"""Trains, is killed, and trains on, again and again; run by test_kills.py in a process of its own.

`kill_driver.py FOLDER KILLS` fails where a folder does not open after a kill, has lost more than
the steps since its last checkpoint, or ends with other bits than a run that nobody disturbed.
Children are forked from a process that has compiled everything, so that a kill costs a fraction of
a second; each trains into the newest run folder with or without --resume, as a person would.
"""

import contextlib
import io
import mmap
import os
import random
import signal
import struct
import sys
import time
from itertools import count
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from capture import factory
from training.toys import assert_same_state, quick_settings

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.training.optimize.precompile import precompile_kernels
from stga_addon.training.run import checkpoint as checkpoints
from stga_addon.training.run import metrics_log
from stga_addon.training.run import session as run_module
from stga_addon.training.run.folder import Run, read_run

ITERATIONS = 250
INTERVAL = 6.0  # a step takes one second of the clock below
REACHED = mmap.mmap(-1, 8)
"""The child's last iteration, readable after its death."""


def train(run, out):
    ticks = count()
    run_module.perf_counter = lambda: float(next(ticks))
    run_module.CHECKPOINT_S = INTERVAL

    def report(progress):
        REACHED[:] = struct.pack("q", int(progress.figures().get("iteration", 0)))
        return False

    resume = (out / "run.json").exists()
    run_module.train_run(open_capture(run.capture), out, run, resume=resume, report=report)


def spawn(run, out):
    """A forked child that trains; exits with 0 when the run is finished."""
    REACHED[:] = bytes(8)
    child = os.fork()
    if child == 0:
        code = 1
        with contextlib.suppress(BaseException), contextlib.redirect_stdout(io.StringIO()):
            train(run, out)
            code = 0
        os._exit(code)
    return child


def last_iteration(out, faces):
    """Read everything that a run folder may hold; the iteration of its checkpoint."""
    if (out / "run.json").exists():
        read_run(out)
    if (out / "avatar.npz").exists():
        read_avatar(out / "avatar.npz")
    metrics_log.read_metrics(out)
    if not (out / "checkpoint.npz").exists():
        return 0
    checkpoints.read_selection(out, faces)
    return checkpoints.read_checkpoint(out).iteration


def main(root, kills):
    capture = open_capture(factory.write_mesh_capture(root / "capture", (0, 1, 3, 4), range(4)))
    settings = quick_settings(
        iterations=ITERATIONS,
        density_interval=5,
        density_span=(0.0, 1.0),
        stray_reset_interval=4,
        stray_limit=0.3,
        lattice=1,
    )
    run = Run(capture.root, None, "vhap", settings)
    whole = root / "whole"
    precompile_kernels()
    start = time.monotonic()
    os.waitpid(spawn(run, whole), 0)
    longest_s = time.monotonic() - start  # until a kill: a loaded machine needs longer to begin
    delays = random.Random(5)
    out = root / "run0"
    number = before = deaths = in_training = 0
    while deaths < kills:
        child = spawn(run, out)
        time.sleep(delays.uniform(0, longest_s))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        reached = struct.unpack("q", REACHED)[0]
        iteration = last_iteration(out, len(capture.faces))
        assert iteration >= max(before, reached - INTERVAL - 1), (out, before, reached, iteration)
        before = iteration
        if os.WIFSIGNALED(status):
            deaths += 1
            in_training += reached > 0
        else:
            assert status == 0
            assert_same_state(out, whole)
            number = number + 1
            before = 0
            out = root / f"run{number}"
    assert os.waitpid(spawn(run, out), 0)[1] == 0
    assert_same_state(out, whole)
    assert in_training > kills // 3  # not only before it or after its end
    assert not [*root.glob("run*/.*"), *root.glob("run*/run.lock")]


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
