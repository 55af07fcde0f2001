"""Runs in processes of their own: turns, interruption, continuation, failure."""

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stga_addon.capture.model import Capture
from stga_addon.development.benchmark import scheduler as race_module
from stga_addon.development.benchmark.benchmark import run_benchmark
from stga_addon.development.benchmark.scheduler import BenchmarkRun, race
from stga_addon.development.benchmark.variants import KNOBS, MAIN, chosen
from stga_addon.development.benchmark.worker import QUALITY, Turns, work
from stga_addon.errors import StgaError
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.folder import Run, write_run
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.progress import Progress
from stga_addon.training.settings import make_settings

TINY = {"lattice": 0, "hull_points": False, "sh_degree": 0, "sh_steps": (), "density_interval": 0}
VARIANTS = {"standard": TINY, "coarse": {**TINY, "scale": 0.5}}


def job_of(capture: Capture, out: Path, **changes: Any) -> BenchmarkRun:
    return BenchmarkRun(Run(capture.root, None, "vhap", make_settings(**{**TINY, **changes})), out)


def progress(share: float, iteration: int = 1) -> Progress:
    return Progress(share, iteration, 1.0, 0.0, None, 1, 1.0)


def test_turns() -> None:
    """Catches a run that trains out of its turn, one that waits after its end, and one that outlives its parent."""
    answers = io.StringIO()
    turns = Turns(io.StringIO("0.5\n0.7\n"), answers)
    assert not turns.report(progress(0.0, iteration=0))  # still compiling
    assert answers.getvalue() == ""
    for share in (0.1, 0.3, 0.49, 0.52):
        assert not turns.report(progress(share, 3))
    assert [json.loads(line)["share"] for line in answers.getvalue().splitlines()] == [0.1, 0.52]
    assert turns.report(progress(0.7))  # no more orders: stop
    ended = Turns(io.StringIO(""), answers)
    assert not ended.report(progress(1.0))


def test_one_job(toy: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a runner that leaves no figures of the finished avatar, and mistakes that end in a traceback."""
    monkeypatch.setattr("stga_addon.development.benchmark.worker.WARM_UP", 0.01)
    job = job_of(toy, tmp_path / "run", iterations=20)
    write_run(job.out, job.run)
    answers = io.StringIO()
    work(job.out, io.StringIO("0.5\n1.0\n"), answers)
    first, second, last = (json.loads(line) for line in answers.getvalue().splitlines())
    assert (first["iteration"], second["share"], last) == (1, 0.5, {"done": True})
    quality = json.loads((job.out / QUALITY).read_text())
    assert {"psnr", "ssim", "psnr_mask", "psnr_moving"} <= set(quality["val"]) & set(quality["test"])
    assert job.finished
    answers = io.StringIO()
    write_run(tmp_path / "lost", replace(job.run, capture=tmp_path / "nowhere"))
    work(tmp_path / "lost", io.StringIO(), answers)
    assert "nowhere" in json.loads(answers.getvalue())["error"]


def interrupt_at(text: str, told: list[str]) -> Callable[[str], None]:
    def tell(line: str) -> None:
        told.append(line)
        if text in line:
            raise KeyboardInterrupt

    return tell


@pytest.mark.slow
def test_a_benchmark_is_interrupted_and_goes_on(toy: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches work lost to Ctrl-C, runs trained twice or not in turns, and files that are missing at the end."""
    monkeypatch.setattr(race_module, "SLICE_S", 0.5)
    run = Run(toy.root, None, "vhap", make_settings(seconds=1.0))
    told: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        run_benchmark(toy, run, VARIANTS, 2.0, 1, tmp_path, interrupt_at("2 of 4 turns", told))
    assert told[-1] == f"what is finished stands in {tmp_path / 'report.txt'}; the same command goes on from here"
    assert "no run is finished yet" in (tmp_path / "report.txt").read_text()
    kept = {name: read_checkpoint(tmp_path / f"{name}-0").elapsed_s for name in VARIANTS}
    assert all(0.5 <= elapsed < 1.9 for elapsed in kept.values())
    told.clear()
    report = run_benchmark(toy, run, VARIANTS, 2.0, 1, tmp_path, told.append)
    assert (
        told[1]
        == f"{len(VARIANTS)} runs of 2 s: {2 * len(VARIANTS)} s of training; what starting and measuring take is on top"
    )
    assert [text for text in told if ": starting" in text] == [f"seed 0: starting {name}-0" for name in VARIANTS]
    for name in VARIANTS:
        assert f"| {name}" in report
        checkpoint, lines = read_checkpoint(tmp_path / f"{name}-0"), read_metrics(tmp_path / f"{name}-0")
        assert checkpoint.elapsed_s >= 2 > kept[name]
        assert [line["iteration"] for line in lines] == sorted(line["iteration"] for line in lines)
    assert (tmp_path / "report.txt").read_text() == report + "\n"
    assert {run["variant"] for run in json.loads((tmp_path / "benchmark.json").read_text())["runs"]} == set(VARIANTS)
    assert (tmp_path / "benchmark.csv").read_text().startswith("variant,seed,iteration,seconds,")
    assert (tmp_path / "benchmark.png").stat().st_size > 1000
    told.clear()
    assert run_benchmark(toy, run, VARIANTS, 2.0, 1, tmp_path, told.append) == report
    assert told == ["deciding about effects"]
    with pytest.raises(StgaError, match="holds a run with other settings"):
        run_benchmark(toy, run, VARIANTS, 3.0, 2, tmp_path, told.append)


@pytest.mark.slow
def test_one_failure_does_not_end_the_others(toy: Capture, tmp_path: Path) -> None:
    """Catches an hour of runs lost to one that cannot be trained."""
    good = job_of(toy, tmp_path / "good", seconds=0.5)
    lost = job_of(toy, tmp_path / "lost", seconds=0.5)
    lost = replace(lost, run=replace(lost.run, capture=tmp_path / "nowhere"))
    told: list[str] = []
    race([lost, good], told.append)
    assert good.finished
    assert not lost.finished
    assert [text for text in told if "failed" in text] == [text for text in told if text.startswith("lost failed: ")]
    assert "nowhere" in told[-1]


def test_variants() -> None:
    """Catches a variant whose settings cannot be made, or that the table cannot compare with the standard."""
    for variants in (MAIN, KNOBS):
        made = [make_settings(**{"seconds": 1.0, **changes}) for changes in variants.values()]
        assert len({json.dumps(str(replace(settings, preset=None))) for settings in made}) == len(variants)
        assert "standard" in variants
    assert list(chosen(MAIN, ["final", "draft"])) == ["draft", "final"]
    with pytest.raises(StgaError, match="--only: 'fast' is not one of draft, standard"):
        chosen(MAIN, ["fast"])
