"""Trains, is killed, and trains on, again and again; run by test_kills.py in a process of its own.

`kill_driver.py FOLDER KILLS` prints one JSON object: what was found after each kill. Children are
forked from a process that has compiled everything, so that a kill costs a fraction of a second;
each opens the capture with which the process began and trains into the newest run folder with or
without --resume, as a person would.
"""

import contextlib
import io
import json
import mmap
import os
import random
import signal
import struct
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from capture import factory
from training.toys import quick_settings

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.errors import StgaError
from stga_addon.training.optimize.precompile import precompile_kernels
from stga_addon.training.optimize.state import arrays_of
from stga_addon.training.run import checkpoint as checkpoints
from stga_addon.training.run import folder as run_folder
from stga_addon.training.run import metrics_log
from stga_addon.training.run import session as run_module
from stga_addon.training.run.folder import Run

ITERATIONS = 250
INTERVAL = 6.0  # a step takes one second of the clock below
LONGEST_S = 0.3  # until a kill


class Driver:
    def __init__(self, root: Path) -> None:
        folder = factory.write_mesh_capture(root / "capture", (0, 1, 3, 4), range(4))
        self.capture = open_capture(folder)
        busy = {
            "density_interval": 5, "density_span": (0.0, 1.0), "stray_reset_interval": 4,
            "stray_limit": 0.3, "lattice": 1,
        }  # fmt: skip
        settings = quick_settings(iterations=ITERATIONS, **busy)
        self.run = Run(self.capture.root, None, "vhap", settings)
        self.reached = mmap.mmap(-1, 8)  # the child's last iteration, readable after its death

    def train(self, out: Path, resume: bool) -> None:
        ticks = iter(range(1 << 60))
        run_module.perf_counter = lambda: float(next(ticks))
        run_module.CHECKPOINT_S = INTERVAL

        def report(progress: run_module.Progress) -> bool:
            self.reached[:] = struct.pack("q", int(progress.figures().get("iteration", 0)))
            return False

        run_module.train(self.capture, out, self.run, resume=resume, report=report)

    def spawn(self, out: Path, resume: bool) -> int:
        """A forked child that trains; exits with 0 when the run is finished."""
        self.reached[:] = struct.pack("q", 0)
        child = os.fork()
        if child:
            return child
        code = 1
        with contextlib.suppress(BaseException), contextlib.redirect_stdout(io.StringIO()):
            self.train(out, resume)
            code = 0
        os._exit(code)

    def kill_one(self, out: Path, delay: float) -> dict[str, Any]:
        """Train for `delay` seconds at most; what the folder holds then."""
        resume = (out / "run.json").exists()
        child = self.spawn(out, resume)
        time.sleep(delay)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        return {
            "killed": os.WIFSIGNALED(status),
            "code": 0 if os.WIFSIGNALED(status) else os.WEXITSTATUS(status),
            "reached": struct.unpack("q", self.reached)[0],
            "resume": resume,
            **opened(out, len(self.capture.faces)),
        }


def opened(out: Path, faces: int) -> dict[str, Any]:
    """Read everything that a run folder may hold; "error" where something that exists cannot be
    read."""
    found = {"iteration": 0, "error": None}
    try:
        if (out / "run.json").exists():
            run_folder.read_run(out)
        if (out / "checkpoint.npz").exists():
            checkpoints.read_selection(out, faces)
            found["iteration"] = checkpoints.read_checkpoint(out).iteration
        if (out / "avatar.npz").exists():
            read_avatar(out / "avatar.npz")
        metrics_log.read_metrics(out)
    except StgaError as error:
        found["error"] = str(error)
    return found


def same_bits(out: Path, expected: Path) -> bool:
    states = (checkpoints.read_checkpoint(folder).state for folder in (out, expected))
    ours, theirs = map(arrays_of, states)
    return all(ours[name].tobytes() == theirs[name].tobytes() for name in theirs)


def main(root: Path, kills: int) -> dict[str, Any]:
    driver = Driver(root)
    precompile_kernels()
    whole = root / "whole"
    os.waitpid(driver.spawn(whole, False), 0)
    delays = random.Random(5)
    records = []
    finished = []
    folder = 0
    while sum(record["killed"] for record in records) < kills:
        out = root / f"run{folder}"
        record = {"folder": folder, **driver.kill_one(out, delays.uniform(0, LONGEST_S))}
        records.append(record)
        if record["error"] or record["code"]:
            break
        if not record["killed"]:
            finished.append(same_bits(out, whole))
            folder += 1
    out = root / f"run{folder}"
    if out.exists() and not records[-1]["error"]:
        os.waitpid(driver.spawn(out, (out / "run.json").exists()), 0)
        finished.append(same_bits(out, whole))
    litter = [path.name for name in (".*", "run.lock") for path in root.glob(f"run*/{name}")]
    return {"records": records, "finished": finished, "litter": litter}


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), int(sys.argv[2]))))
