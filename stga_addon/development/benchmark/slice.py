"""A slice of a benchmark: every variant with one seed, trained in turns."""

from dataclasses import replace

from ...errors import StgaError
from ...perform.training import prepare
from ...progress import Progress, Report, Say, ignore
from ...requests.results import Written
from ...requests.values import Benchmark, Train
from .scheduler import BenchmarkRun, train_in_turns
from .variants import Changes, settings_of, variants_of, without_choices


def train_slice(request: Benchmark, report: Report, say: Say) -> Written:
    """Train and measure the runs that are not finished.

    Raises Cancelled when the report stops it and the runs are saved, and StgaError where a run has failed; then the
    others are finished.
    """
    report(Progress(stage="Deciding effects"))
    runs = runs_of(request)
    for run in runs:
        run.check()
    failures = train_in_turns(runs, say, report)
    if failures:
        raise StgaError("; ".join(f"{name} failed: {error}" for name, error in failures.items()))
    return Written(request.out)


def runs_of(request: Benchmark) -> list[BenchmarkRun]:
    """A run of each variant, with its effects decided; a variant with the settings of an earlier one is left out."""
    requests: list[Train] = []
    for name, changes in variants_of(request).items():
        asked = _training(request, name, changes)
        settings = without_choices(prepare(asked, ignore, lambda line: None).run.settings)
        if not any(replace(settings, preset=other.settings.preset) == other.settings for other in requests):
            requests.append(replace(asked, settings=settings))
    fits = any(each.settings.exposure for each in requests)  # for all variants or none, so that they compare
    return [BenchmarkRun(each, fits) for each in requests]


def _training(request: Benchmark, name: str, changes: Changes) -> Train:
    settings = replace(settings_of(changes, request.seconds), seed=request.seed)
    return Train(request.out / name, request.capture, settings, request.flame, request.principal_point, device="cpu")
