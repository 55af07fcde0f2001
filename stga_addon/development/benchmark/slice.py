"""A slice of a benchmark: every variant with one seed, trained in turns."""

from dataclasses import replace
from pathlib import Path

from ...errors import StgaError
from ...jobs.train import Train, prepare
from ...progress import Log, Progress, Report, Written, ignore
from ...training.settings import TrainingSettings
from .scheduler import BenchmarkRun, train_in_turns
from .variants import Benchmark, settings_of, variants_of, without_choices


def train_slice(request: Benchmark, report: Report, log: Log) -> Written:
    """Train and measure the runs that are not finished.

    Raises Cancelled when the report stops it and the runs are saved, and StgaError where a run has
    failed; then the others are finished.
    """
    report(Progress(stage="Deciding effects"))
    runs = runs_of(request)
    for run in runs:
        run.check()
    failures = train_in_turns(runs, log, report)
    if failures:
        raise StgaError("; ".join(f"{name} failed: {error}" for name, error in failures.items()))
    return Written(request.out)


def runs_of(request: Benchmark) -> list[BenchmarkRun]:
    """A run of each variant; a variant with the settings of an earlier one is left out. Effects are
    decided as for every other seed."""
    decided: dict[str, TrainingSettings] = {}
    for name, changes in variants_of(request).items():
        undecided = _training(
            request, request.out / "undecided" / name, settings_of(changes, request.seconds)
        )
        settings = without_choices(prepare(undecided, ignore, lambda line: None).run.settings)
        if not any(replace(settings, preset=other.preset) == other for other in decided.values()):
            decided[name] = settings
    # for all variants or none, so that they compare
    fits = any(settings.exposure for settings in decided.values())
    seeded = {name: replace(settings, seed=request.seed) for name, settings in decided.items()}
    return [
        BenchmarkRun(_training(request, request.out / name, settings), fits)
        for name, settings in seeded.items()
    ]


def _training(request: Benchmark, run: Path, settings: TrainingSettings) -> Train:
    return Train(
        run, request.capture, settings, request.flame, request.principal_point, device="cpu"
    )
