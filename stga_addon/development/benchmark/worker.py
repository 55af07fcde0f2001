"""One run of a benchmark, in a process of its own that trains when it is told to.

    python -m stga_addon.development.benchmark.worker FOLDER

Trains, or goes on with, the run that FOLDER/run.json describes. Reads shares of the budget, one a line, each of which
it trains up to; the end of its input means stop and keep what there is. Answers every line, and the start, with a line
of JSON: {"share": …, "iteration": …} while it waits, {"done": …} at the end, {"error": …} instead of either.
"""

import json
import sys
from pathlib import Path
from typing import IO, Any

from ...avatar.file import read_avatar
from ...capture.open import open_capture
from ...errors import StgaError
from ...files import write_json
from ...report.preset_timing import seconds_per_iteration
from ...training.evaluate.metrics import evaluate_avatar
from ...training.optimize.tracking import with_refined_tracking
from ...training.run.folder import read_run
from ...training.run.loop import train
from ...training.run.progress import Progress

WARM_UP = 1.0
"""Seconds of training before the run that are not counted: caches fill and the clock of the processor rises."""
QUALITY = "quality.json"
"""The finished avatar on all views of "val" and "test"; its presence says that the run is finished."""


class Turns:
    """Lets a run train up to a share of its budget, then makes it wait for the next one.

    dismissed  no more turns come
    """

    def __init__(self, orders: IO[str], answers: IO[str]) -> None:
        self._orders, self._answers = orders, answers
        self._until = 0.0
        self.dismissed = False

    def report(self, progress: Progress) -> bool:
        """To be called after every iteration: answers True where the run is to stop."""
        if progress.iteration == 0 or self._until > progress.share or progress.share >= 1:
            return False
        self.answer({"share": progress.share, "iteration": progress.iteration})
        order = self._orders.readline()
        self.dismissed = not order
        self._until = float(order or 1)
        return self.dismissed

    def answer(self, message: dict[str, Any]) -> None:
        self._answers.write(json.dumps(message) + "\n")
        self._answers.flush()


def work(folder: Path, orders: IO[str], answers: IO[str]) -> None:
    """Train the folder's run in turns, and measure what came of it."""
    turns = Turns(orders, answers)
    try:
        run = read_run(folder)
        capture = open_capture(run.capture, run.flame, run.principal_point)
        seconds_per_iteration(capture, run.settings, WARM_UP)
        avatar = read_avatar(train(capture, folder, run, resume=True, report=turns.report))
        if not turns.dismissed:
            splits = [split for split in ("val", "test") if capture.views.get(split)]
            trained = with_refined_tracking(capture, folder)
            quality = {split: evaluate_avatar(avatar, trained, split, perceptual=True).as_json() for split in splits}
            write_json(folder / QUALITY, quality)
        turns.answer({"done": not turns.dismissed})
    except StgaError as error:
        turns.answer({"error": str(error)})


if __name__ == "__main__":
    work(Path(sys.argv[1]), sys.stdin, sys.stdout)
