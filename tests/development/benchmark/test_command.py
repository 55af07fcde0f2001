"""`stga benchmark` as typed."""

import re
from pathlib import Path

import pytest
from batch.simulated import InProcessEngine
from capture import factory

from stga_addon.cli.main import main
from stga_addon.training.run.folder import read_run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "fast"], "--only: 'fast' is not one of draft, standard"),
        (["--only", "draft", "--knobs"], "--only: 'draft' is not one of standard, scale-0.5"),
    ],
)
def test_impossible_benchmarks(
    toy_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    """Catches a mistake found only after the first hour."""
    assert main(["benchmark", str(toy_root), "--out", str(tmp_path / "out"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_slices_are_jobs_of_a_batch(
    toy_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a benchmark whose seeds are not jobs, that trains again what is finished, or says
    nothing of a seed."""
    out, options = str(tmp_path / "out"), ["--budget", "1s", "--only", "draft", "--threads", "1"]
    command = ["benchmark", str(toy_root), "--out", out, "--seeds", "2", *options]
    assert main([*command, "--dry-run"]) == 0
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
    assert "benchmark-seed1" in (tmp_path / "out/report.html").read_text()
    monkeypatch.setattr(InProcessEngine, "submit", lambda *_: pytest.fail("it trains again"))
    assert main(command) == 0
    assert capsys.readouterr().out.endswith(printed.partition("report.html\n")[2])


def test_a_benchmark_needs_held_out_views(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches an hour of training of which nothing can be said."""
    root = factory.write_mesh_capture(tmp_path / "one", (0,), range(2))
    (root / "transforms_val.json").unlink()
    assert main(["benchmark", str(root), "--out", str(tmp_path / "out")]) == 2
    assert "has no views to" in capsys.readouterr().err
