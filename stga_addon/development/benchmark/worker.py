"""Benchmark worker: a process that trains one run in turns.

    python -m stga_addon.development.benchmark.worker FOLDER --threads=N [--fit-exposure]

Trains as the request in FOLDER asks (`jobs.perform`), or resumes the run in FOLDER. Each line on
stdin is a fraction of the budget to train up to; the end of stdin means save and end. Each line,
and the start, is answered by a line of JSON on stdout: {"fraction": …, "iteration": …} when ready
for the next, {"done": …} at the end, or {"error": …}.
"""

import json
import sys
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from ...errors import StgaError
from ...files import write_json
from ...jobs.perform import read_request, request_folder
from ...jobs.train import Resume, Train
from ...progress import ignore
from ...training.run.folder import has_run
from ...worker.helpers import claim_stdout

if TYPE_CHECKING:
    from ...progress import Progress

WARM_UP_S = 1.0
"""Seconds of training before the run, not counted: caches fill and the processor's clock rises."""
FIT_EXPOSURE = "--fit-exposure"
"""Option that fits exposure before views are compared."""
THREADS = "--threads"
"""Option that limits the threads of a variant."""
QUALITY = "quality.json"
"""Metrics of the finished avatar on all views of "val" and "test"; the run is finished when the
file exists."""


class Turns:
    """Makes a run wait at the fractions of its budget that it reads.

    stopped  the end of the requests was read
    """

    def __init__(self, requests: IO[str], replies: IO[str]) -> None:
        self._requests = requests
        self._replies = replies
        self._until = 0.0
        self.stopped = False

    def report(self, progress: "Progress") -> bool:
        """Call after every iteration; True where the run is to stop."""
        if self._until > progress.fraction or progress.fraction >= 1:
            return False
        iteration = int(progress.figures().get("iteration", 0))
        if iteration == 0:
            return False
        self.reply({"fraction": progress.fraction, "iteration": iteration})
        request = self._requests.readline()
        self.stopped = not request
        self._until = float(request or 1)
        return self.stopped

    def reply(self, message: dict[str, Any]) -> None:
        self._replies.write(json.dumps(message) + "\n")
        self._replies.flush()


def work(folder: Path, requests: IO[str], replies: IO[str], fits_exposure: bool = False) -> None:
    """Train the folder's run in turns and measure its avatar, with fitted exposure of cameras that
    were not trained."""
    from ...avatar.file import read_avatar
    from ...jobs.finished_run import measure_run
    from ...jobs.train import prepare
    from ...training.evaluate.metrics import with_fitted_heads
    from ...training.preset_timing import seconds_per_iteration

    turns = Turns(requests, replies)
    try:
        request = (
            Resume(folder, device="cpu")
            if has_run(folder)
            else read_request(request_folder(folder))
        )
        assert isinstance(request, Train | Resume)
        prepared = prepare(request, ignore, partial(print, file=sys.stderr))
        capture = prepared.capture
        seconds_per_iteration(capture, prepared.run.settings, 1, WARM_UP_S)
        avatar = read_avatar(prepared.train_as_asked(turns.report).path)
        if not turns.stopped:
            splits = [split for split in ("val", "test") if capture.views.get(split)]
            quality = {}
            for split in splits:
                found, fitted = measure_run(folder, avatar, capture, split, fits_exposure)
                beside = {} if fitted is None else fitted.as_json()
                quality[split] = with_fitted_heads(found.as_json(), beside)
            write_json(folder / QUALITY, quality)
        turns.reply({"done": not turns.stopped})
    except StgaError as error:
        turns.reply({"error": str(error)})


if __name__ == "__main__":
    from ...raster.cpu.threads import set_threads

    set_threads(next(int(text.partition("=")[2]) for text in sys.argv if text.startswith(THREADS)))
    work(
        Path(sys.argv[1]),
        sys.stdin,
        TextIOWrapper(claim_stdout(), encoding="utf-8"),
        FIT_EXPOSURE in sys.argv,
    )
