"""The lines at the end of a run."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stga_addon import report
from stga_addon.capture.model import Capture
from stga_addon.format import describe_figures
from stga_addon.report import CURVE, CurveUpdater, report_run, summarize_continuation, summarize_run
from stga_addon.training.evaluate.forecast import describe_forecast
from stga_addon.training.run.folder import Run
from stga_addon.training.run.session import train
from stga_addon.training.settings import make_settings


def metrics(values: list[float], **more: Any) -> list[dict[str, Any]]:
    return [
        {
            "seconds": 10.0 * n, "psnr": psnr, "ssim": 0.9, "detail_difference": 1 / psnr,
            "iteration": n, "evaluation_s": 0.2, **more,
        }
        for n, psnr in enumerate(values, 1)
    ]  # fmt: skip


def test_summary_of_a_run() -> None:
    """Catches the last evaluation given for the best one, and figures that were not measured."""
    lines = summarize_run(metrics([20.0, 31.0, 30.0], psnr_mask=25.0, peak_memory_mb=1234.5), None)
    assert lines[0] == (
        "held-out views: 31.00 dB, SSIM 0.9000, 25.00 dB in the head mask, detail difference "
        "0.0323, after 20 s"
        " (the saved avatar)"
    )
    assert (
        lines[-1]
        == "evaluation took 1.3% of the training time, in addition to it, peak memory 1,234 MB"
    )
    assert len(lines) == 2
    assert summarize_run([], None) == []


def test_summary_of_a_continuation() -> None:
    """Catches before and after exchanged, and a fitted PSNR that is not called so."""
    before, after = metrics([30.0, 32.0], psnr_take_2=20.0, psnr_unmatched=15.0, splats=9)
    lines = summarize_continuation([before, {**after, "psnr_take_2": 19.5, "splats": 12}])
    assert lines == [
        "splats: 9 before, 12 after",
        "held-out views (exposure fitted): 30.00 dB before, 32.00 dB after (+2.00)",
        "held-out views (exposure not fitted): 15.00 dB before, 15.00 dB after (+0.00)",
        "take 2 (exposure fitted): 20.00 dB before, 19.50 dB after (-0.50)",
    ]


def test_fitted_exposure_is_said() -> None:
    """Catches a PSNR that six numbers a view were fitted for, shown like one without: in the
    summary, beside the target, in the forecast and in the panel."""
    values = metrics([20.0, 31.0, 30.0], psnr_unmatched=25.0)
    summary = summarize_run(values, 30.5)
    assert summary[0].startswith(
        "held-out views: 31.00 dB (exposure fitted; 25.00 dB without), SSIM"
    )
    assert summary[1] == "30.5 dB was reached (exposure fitted)"
    assert "(exposure fitted)" in summarize_run(values, 40.0)[1]
    rising = metrics([20.0, 25.0, 27.0, 28.0, 28.5], psnr_unmatched=25.0)
    assert "PSNR with exposure fitted" in describe_forecast(rising, 50.0, 100.0, None)
    assert "at the end, exposure fitted" in describe_forecast(rising, 50.0, 100.0, 60.0)
    assert "PSNR 31.00 dB (exposure fitted)   25.00 dB without" in describe_figures(
        {"psnr": 31.0, "psnr_unmatched": 25.0}
    )
    assert "PSNR 31.00 dB" in " ".join(describe_figures({"psnr": 31.0}))


def test_targets_and_plateaus() -> None:
    """Catches a target that is reached and said to be missed, or the other way round."""
    assert "30 dB was reached" in summarize_run(metrics([20.0, 31.0, 29.0]), 30.0)
    missed = summarize_run(metrics([20.0, 25.0, 27.0, 28.0]), 30.0)[1]
    assert missed.startswith(
        "30 dB was not reached (best 28.00 dB): extrapolating the curve, it would take about"
    )
    level = summarize_run(metrics([20.0, 25.0, *[24.0] * 10]), 30.0)
    assert "nothing was gained after 20 s, so more time would not help" in level[1]
    assert "nothing was gained after 20 s" in level[2]
    late = metrics([29.0, 31.0])
    late[1]["detail_difference"] = 0.9  # worse than before, but it is the avatar that was asked for
    assert summarize_run(late, 30.0)[0].startswith("held-out views: 31.00 dB")


def test_report_of_a_finished_run(toy: Capture, tmp_path: Path) -> None:
    """Catches metrics that a run writes and the summary cannot read, and a missing picture."""
    train(
        toy,
        tmp_path,
        Run(toy.root, None, "vhap", make_settings(iterations=12, hull_points=False, lattice=0)),
    )
    assert report_run(tmp_path)[0].startswith("held-out views: ")
    assert (tmp_path / CURVE).stat().st_size > 1000


def test_the_reason_for_no_curve(toy, tmp_path, monkeypatch):
    """Catches a missing library blamed where there was nothing to draw, and the other way round."""
    run = Run(toy.root, None, "vhap", make_settings(iterations=3, hull_points=False, lattice=0))
    train(replace(toy, views={"train": toy.views["train"]}), tmp_path / "bare", run)
    assert (
        report_run(tmp_path / "bare")[-1]
        == f"{CURVE} was not drawn: no held-out views (split 'val') were evaluated"
    )
    train(toy, tmp_path / "run", run)
    monkeypatch.setattr(report, "find_spec", lambda name: None)
    assert report_run(tmp_path / "run")[-1] == f"{CURVE} was not drawn: matplotlib is not installed"


def test_the_curve_is_drawn_while_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a picture that comes only at the end, is drawn again without need, or takes more than
    its share."""
    now, drawn = [0.0], []

    def draw(folder: Path) -> None:
        drawn.append(now[0])
        now[0] += 0.05

    monkeypatch.setattr(report, "perf_counter", lambda: now[0])
    monkeypatch.setattr(report, "write_curve", draw)
    keep = CurveUpdater(tmp_path)
    for second in range(51):
        now[0] = float(second)
        if second in (0, 31, 46):
            with (tmp_path / "metrics.jsonl").open("a") as out:
                out.write("{}\n")
        keep()
    assert drawn == [30.0, 36.0, 46.0]
