"""Benchmark runs in worker processes: turns, interruption, continuation, failure."""

import io
import json
import re
import subprocess
import sys
from dataclasses import replace

import pytest
from batch.simulated import InProcessEngine
from command_line import stga
from refusal import refusal

import stga_addon.development.commands  # noqa: F401 (adds its requests)
from stga_addon.cli.main import main
from stga_addon.development.benchmark import scheduler, variants
from stga_addon.development.benchmark.benchmark import write_report
from stga_addon.development.benchmark.scheduler import BenchmarkRun, train_in_turns
from stga_addon.development.benchmark.slice import runs_of
from stga_addon.development.benchmark.variants import (
    MAIN_VARIANTS,
    SETTING_VARIANTS,
    Benchmark,
    select_variants,
)
from stga_addon.development.benchmark.worker import QUALITY, work
from stga_addon.jobs.perform import perform, request_folder, write_request
from stga_addon.jobs.train import Train
from stga_addon.progress import Cancelled, Progress
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.folder import read_run
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.settings import make_settings

TINY = {"lattice": 0, "hull_points": False, "sh_degree": 0, "sh_steps": (), "density_interval": 0}
VARIANTS = {"standard": TINY, "coarse": {**TINY, "scale": 0.5}}


def run_in(capture, out, **changes):
    return BenchmarkRun(
        Train(out, capture.root, make_settings(**{**TINY, **changes}), device="cpu")
    )


def progress(share, iteration=1):
    return Progress(share, figures=lambda: {"iteration": iteration})


def test_one_run(toy, tmp_path, monkeypatch):
    """Catches a worker without figures of the finished avatar, and mistakes as tracebacks."""
    monkeypatch.setattr("stga_addon.development.benchmark.worker.WARM_UP_S", 0.01)
    run = run_in(toy, tmp_path / "run", iterations=20)
    write_request(request_folder(run.out), run.request)
    replies = io.StringIO()
    work(run.out, io.StringIO("0.5\n1.0\n"), replies)
    first, second, last = (json.loads(line) for line in replies.getvalue().splitlines())
    assert (first["iteration"], second["fraction"], last) == (1, 0.5, {"done": True})
    quality = json.loads((run.out / QUALITY).read_text())
    for split in ("val", "test"):
        assert {"psnr", "ssim", "psnr_mask", "psnr_moving"} <= set(quality[split])
    assert run.finished
    assert "psnr_unmatched" not in quality["val"]
    work(run.out, io.StringIO(), io.StringIO(), fits_exposure=True)
    assert "psnr_unmatched" in json.loads((run.out / QUALITY).read_text())["val"]
    replies = io.StringIO()
    lost = replace(run.request, run=tmp_path / "lost", capture=tmp_path / "nowhere")
    write_request(request_folder(lost.run), lost)
    work(tmp_path / "lost", io.StringIO(), replies)
    assert "nowhere" in json.loads(replies.getvalue())["error"]


@pytest.mark.nightly
def test_a_slice_is_stopped_and_goes_on(toy, tmp_path, monkeypatch):
    """Catches training lost to Ctrl-C or done twice, and files that are missing at the end."""
    monkeypatch.setattr(variants, "MAIN_VARIANTS", VARIANTS)
    monkeypatch.setattr(scheduler, "TURN_S", 0.5)
    request = Benchmark(tmp_path, toy.root, 2.0, seed=4)
    said = []

    def stop(progress):
        return progress.detail == "Turn 3 of 4"

    with pytest.raises(Cancelled):
        perform(request, stop, said.append)
    assert write_report([request], tmp_path).endswith("no run is finished yet")
    kept = {name: read_checkpoint(tmp_path / name).elapsed_s for name in VARIANTS}
    assert all(0.5 <= elapsed < 1.9 for elapsed in kept.values())
    said.clear()
    shares = []
    perform(request, lambda progress: bool(shares.append(progress.fraction)), said.append)
    starts = [text for text in said if "Starting" in text]
    assert starts == [f"Starting {name}" for name in VARIANTS]
    assert shares == sorted(shares)
    report = write_report([request], tmp_path)
    for name in VARIANTS:
        assert f"| {name}" in report
        checkpoint = read_checkpoint(tmp_path / name)
        lines = read_metrics(tmp_path / name)
        assert checkpoint.elapsed_s >= 2 > kept[name]
        assert [line["iteration"] for line in lines] == sorted(line["iteration"] for line in lines)
        assert read_run(tmp_path / name).settings.seed == 4
    assert (tmp_path / "report.txt").read_text() == report + "\n"
    runs = json.loads((tmp_path / "benchmark.json").read_text())["runs"]
    assert {run["variant"] for run in runs} == set(VARIANTS)
    assert (tmp_path / "benchmark.csv").read_text().startswith("variant,seed,iteration,seconds,")
    assert (tmp_path / "benchmark.png").stat().st_size > 1000
    said.clear()
    perform(request, log=said.append)
    assert [text for text in said if "Starting" in text] == []
    with refusal("holds a run with other settings"):
        perform(replace(request, seconds=3.0))


def test_exposure_is_fitted_for_all_or_none(toy, tmp_path, monkeypatch):
    """Catches variants measured with fitted exposure beside others without it."""
    request = Benchmark(tmp_path, toy.root, 2.0)
    rows = ((0.0, 1.1, 1.0, 1.0, 0.0, 0.0, 0.0),)
    off = {"effects": {"exposure": "off"}}
    plain = {name: {**changes, **off} for name, changes in VARIANTS.items()}
    with_rows = {
        "paper": {**TINY, "schedule": "paper"},
        "corrected": {**TINY, "exposure": rows, "effects": None},
    }
    fitted = []
    for chosen in (plain, with_rows):
        monkeypatch.setattr(variants, "MAIN_VARIANTS", chosen)
        fitted += [run.fits_exposure for run in runs_of(request)]
    assert fitted == [False, False, True, True]


def test_workers_that_end_or_fail(toy, tmp_path, monkeypatch):
    """Catches ended processes left unreaped, and hours of runs lost to one failure."""
    interpreter = tmp_path / "python"  # trains in one turn, or cannot in the folder `lost`
    interpreter.write_text(
        '#!/bin/sh\ncase "$*" in */lost*) echo \'{"error": "nowhere"}\'; exit;; esac\n'
        'echo \'{"fraction": 0.1}\'\nread share\ntouch "$0.trained"\necho \'{"done": true}\'\n'
    )
    interpreter.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(interpreter))
    monkeypatch.setattr(scheduler, "TURN_S", 0.5)
    started = []

    class Recorded(subprocess.Popen[str]):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)

    ended = []
    monkeypatch.setattr(subprocess, "Popen", Recorded)
    runs = [run_in(toy, tmp_path / name, seconds=1.0) for name in ("first", "second")]

    def look(text):
        ended.append([process.returncode is not None for process in started])

    train_in_turns(runs, look)
    assert ended == [[], [False], [False, False], [True, True]]  # two starts, two turns
    runs = [run_in(toy, tmp_path / name, seconds=1.0) for name in ("lost", "good")]
    assert train_in_turns(runs, lambda text: None) == {"lost": "nowhere"}
    assert (tmp_path / "python.trained").exists()


def test_variants():
    """Catches a variant without settings of its own, and a table without the standard."""
    for table in (MAIN_VARIANTS, SETTING_VARIANTS):
        made = [make_settings(**{"seconds": 1.0, **changes}) for changes in table.values()]
        assert len({str(replace(settings, preset=None)) for settings in made}) == len(table)
        assert "standard" in table
    assert list(select_variants(MAIN_VARIANTS, ["final", "draft"])) == ["draft", "final"]


@pytest.mark.nightly
def test_slices_are_jobs_of_a_batch(toy_root, tmp_path, capsys, monkeypatch):
    """Catches seeds that are no jobs, a finished one trained again, and no word of one."""
    out = str(tmp_path / "out")
    options = ["--budget", "1s", "--only", "draft", "--threads", "1"]
    command = ["benchmark", str(toy_root), "--out", out, "--seeds", "2", *options]
    assert stga(*command, "--dry-run") == 0
    printed = capsys.readouterr().out
    assert re.search(r"benchmark-seed0 +Benchmark +1 thread, 1 GB +1 s\n", printed)
    assert "2 jobs, 2 to do; 2 s of work" in printed
    monkeypatch.setattr("stga_addon.jobs.batch.engines.make_engine", lambda *_: InProcessEngine())
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "2 of 2 jobs finished" in printed
    assert "toy0, 1 s of training each, 2 seeds; mean ± spread" in printed
    assert "| draft" in printed
    runs = [read_run(tmp_path / f"out/benchmark-seed{seed}/draft") for seed in (0, 1)]
    assert [run.settings.seed for run in runs] == [0, 1]
    monkeypatch.setattr(InProcessEngine, "submit", lambda *_: pytest.fail("it trains again"))
    assert main(command) == 0
    assert capsys.readouterr().out.endswith(printed[printed.index("toy0, 1 s") :])
