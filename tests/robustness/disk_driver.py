"""Trains on a disk of its own until it is full, then on one that cannot be written; run by
test_disks.py.

`disk_driver.py DISK CAPTURE` prints one JSON object. DISK must be a small mount that nobody else
sees.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from training.toys import quick_settings

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.errors import StgaError
from stga_addon.training.run import checkpoint as checkpoints
from stga_addon.training.run import session as run_module
from stga_addon.training.run.folder import Run

ITERATIONS = 24
FULL_AT = 8  # the next step writes a checkpoint and no avatar


def main(disk: Path, root: Path) -> dict[str, Any]:
    run_module.CHECKPOINT_S = 0.0
    capture = open_capture(root)
    out, filler = disk / "run", disk / "filler"
    run = Run(capture.root, None, "vhap", quick_settings(iterations=ITERATIONS, lattice=1))

    def fill(progress: run_module.Progress) -> bool:
        if progress.figures().get("iteration", 0) == FULL_AT:
            with open(filler, "wb", buffering=0) as file:
                try:
                    while True:
                        file.write(b"x" * 4096)
                except OSError:
                    pass
        return False

    def message(report: run_module.Report = lambda progress: False, resume: bool = False) -> str:
        try:
            run_module.train(capture, out, run, resume=resume, report=report)
        except StgaError as error:
            return str(error)
        return ""

    found: dict[str, Any] = {
        "full": message(fill),
        "kept": checkpoints.read_checkpoint(out).iteration,
    }
    found["avatar"] = len(read_avatar(out / "avatar.npz").splats)
    found["litter"] = [path.name for path in out.glob(".*")] + [
        path.name for path in out.glob("run.lock")
    ]
    found["still full"] = message(resume=True)
    filler.unlink()
    remount = ["mount", "-o", "remount,{}", str(disk)]
    subprocess.run([part.format("ro") for part in remount], check=True)
    found["read-only"] = message(resume=True)
    found["read-only kept"] = checkpoints.read_checkpoint(out).iteration
    subprocess.run([part.format("rw") for part in remount], check=True)
    found["resumed"] = message(resume=True)
    found["end"] = checkpoints.read_checkpoint(out).iteration
    return found


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2]))))
