"""How long a user waits from a click on Train to the first preview, stage by stage.

    python benchmarks/start_up.py CAPTURE [--repeats 3] [--cold-kernels]

Writes a request to train with the preset draft, starts the worker that carries it out, as Blender does, and watches its
folder until the preview is there: the median second at which each stage began. --cold-kernels: with an empty cache of
compiled kernels, as after an installation. Run it on an idle machine.
"""

import argparse
import os
import statistics
import sys
import tempfile
from pathlib import Path
from time import perf_counter, sleep

from stga_addon.errors import StgaError
from stga_addon.requests.folder import PREVIEW, worker_arguments, write_request
from stga_addon.requests.values import Train
from stga_addon.training.settings import make_settings
from stga_addon.worker.launch import start_worker
from stga_addon.worker.status import CANCEL_FILE, read_status

POLL_INTERVAL_S = 0.02
TIME_LIMIT_S = 300.0
PREVIEW_STAGE = "first preview"


def watch(capture: Path, folder: Path) -> dict[str, float]:
    """Seconds from the click at which each stage of a training began, and at which the first preview was there.

    Raises StgaError where the worker ends without a preview, or takes longer than TIME_LIMIT_S.
    """
    job = folder / "job"
    begin = perf_counter()
    write_request(job, Train(folder / "run", capture.resolve(), make_settings(preset="draft", seconds=120.0)))
    worker = start_worker(job, sys.executable, worker_arguments(job))
    stages: dict[str, float] = {}
    try:
        while not (job / PREVIEW).exists():
            status, now = read_status(job), perf_counter() - begin
            if status is not None:
                stages.setdefault(status.message, now)
            if worker.poll() is not None or now > TIME_LIMIT_S:
                raise StgaError(f"{job}: no preview after {now:.0f} s ({status and status.error})")
            sleep(POLL_INTERVAL_S)
        stages[PREVIEW_STAGE] = perf_counter() - begin
    finally:
        (job / CANCEL_FILE).touch()
        worker.wait()
    return stages


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, metavar="CAPTURE")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cold-kernels", action="store_true")
    options = parser.parse_args()
    runs = []
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory() as folder:
            if options.cold_kernels:
                os.environ["NUMBA_CACHE_DIR"] = f"{folder}/kernels"
            runs.append(watch(options.capture, Path(folder)))
    for stage in runs[0]:
        print(f"{stage:<28}{statistics.median(run[stage] for run in runs if stage in run):8.1f} s")


if __name__ == "__main__":
    main()
