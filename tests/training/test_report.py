"""The lines at the end of a run, its charts, and the commands around time and accuracy."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from command_line import stga
from numpy.testing import assert_array_equal
from PIL import Image

from stga_addon.development.benchmark.benchmark import benchmark_chart, report_text
from stga_addon.development.benchmark.statistics import MeanCurve, Outcome
from stga_addon.format import MORE_GAIN, describe_figures, describe_quality
from stga_addon.jobs.analyze import Analyze
from stga_addon.jobs.perform import perform
from stga_addon.training import preset_timing
from stga_addon.training.evaluate.forecast import describe_forecast
from stga_addon.training.run import report
from stga_addon.training.run.folder import Run, read_run
from stga_addon.training.run.report import CURVE, report_run, run_chart, summarize_run
from stga_addon.training.run.session import train_run
from stga_addon.training.settings import make_settings


def metrics(values, **more):
    return [
        {
            "seconds": 10.0 * n,
            "psnr": psnr,
            "ssim": 0.9,
            "detail_difference": 1 / psnr,
            "iteration": n,
            "evaluation_s": 0.2,
            **more,
        }
        for n, psnr in enumerate(values, 1)
    ]


def aiming(target):
    return make_settings(iterations=1, target_psnr=target)


def test_summary_of_a_run():
    """Catches the last evaluation given for the best, a fitted PSNR that is not called so, and a
    target that is reached and said to be missed, or the other way round."""
    lines = summarize_run(
        metrics([20.0, 31.0, 30.0], psnr_mask=25.0, peak_memory_mb=1234.5), aiming(None)
    )
    assert lines == [
        "held-out views: 31.00 dB, SSIM 0.9000, 25.00 dB in the head mask, detail difference "
        "0.0323, after 20 s (the saved avatar)",
        "evaluation took 1.3% of the training time, in addition to it, peak memory 1,234 MB",
    ]
    assert summarize_run([], aiming(None)) == []
    values = metrics([20.0, 31.0, 30.0], psnr_unmatched=25.0)
    summary = summarize_run(values, aiming(30.5))
    assert summary[0].startswith(
        "held-out views: 31.00 dB (exposure fitted; 25.00 dB without), SSIM"
    )
    assert summary[1] == "30.5 dB was reached (exposure fitted)"
    assert "(exposure fitted)" in summarize_run(values, aiming(40.0))[1]
    rising = metrics([20.0, 25.0, 27.0, 28.0, 28.5], psnr_unmatched=25.0)
    assert "PSNR with exposure fitted" in describe_forecast(rising, 50.0, 100.0, None)
    assert "at the end, exposure fitted" in describe_forecast(rising, 50.0, 100.0, 60.0)
    assert "PSNR 31.00 dB (exposure fitted)   25.00 dB without" in describe_figures(
        {"psnr": 31.0, "psnr_unmatched": 25.0}
    )
    assert "PSNR 31.00 dB" in " ".join(describe_figures({"psnr": 31.0}))
    assert "30 dB was reached" in summarize_run(metrics([20.0, 31.0, 29.0]), aiming(30.0))
    missed = summarize_run(metrics([20.0, 25.0, 27.0, 28.0]), aiming(30.0))[1]
    assert missed.startswith(
        "30 dB was not reached (best 28.00 dB): extrapolating the curve, it would take about"
    )
    level = summarize_run(metrics([20.0, 25.0, *[24.0] * 10]), aiming(30.0))
    assert "nothing was gained after 20 s, so more time would not help" in level[1]
    assert "nothing was gained after 20 s" in level[2]
    late = metrics([29.0, 31.0])
    late[1]["detail_difference"] = 0.9  # worse than before, but it is the avatar that was asked for
    assert summarize_run(late, aiming(30.0))[0].startswith("held-out views: 31.00 dB")


def test_both_qualities_are_named():
    """Catches heads fitted to the very images that are scored and not called so, and tracking that
    nothing has checked without a warning."""
    values = metrics([20.0, 23.0])
    values[1] |= {"psnr_fitted_heads": 26.0, "ssim_fitted_heads": 0.95}
    values[1]["tracking_gain_db"] = float("nan")
    first, second, third, *_ = summarize_run(values, aiming(None))
    assert first.startswith("held-out views, heads as tracked: 23.00 dB")
    assert second.startswith("held-out views, heads of unseen timesteps fitted to them by the ")
    assert second.endswith(": 26.00 dB, SSIM 0.9500")
    assert third == "tracking by the avatar: kept unchecked: no view could be left out of it"
    quality = {"val": {"psnr": 23.0, "ssim": 0.9, "psnr_fitted_heads": 26.0}}
    lines = [{**line, "splats": 7, "wall_s": 1.0} for line in values]
    table = report_text([Outcome("standard", 0, lines, quality)], {}, 60.0, Path("anna"))
    titles, _, row = (line.split("|") for line in table.splitlines() if line.startswith("| "))
    figures = dict(zip(map(str.strip, titles), map(str.strip, row), strict=True))
    assert (figures["val"], figures["val fitted heads"]) == ("23.00", "26.00")
    assert "the avatar has fitted those of unseen timesteps to the images" in table


def test_summary_of_a_continuation():
    """Catches before and after exchanged, and a fitted PSNR that is not called so."""
    before, after = metrics([30.0, 32.0], psnr_take_2=20.0, psnr_unmatched=15.0, splats=9)
    lines = report.summarize_continuation([before, {**after, "psnr_take_2": 19.5, "splats": 12}])
    assert lines == [
        "splats: 9 before, 12 after",
        "held-out views (exposure fitted): 30.00 dB before, 32.00 dB after (+2.00)",
        "held-out views (exposure not fitted): 15.00 dB before, 15.00 dB after (+0.00)",
        "take 2 (exposure fitted): 20.00 dB before, 19.50 dB after (-0.50)",
    ]


@pytest.mark.parametrize(("after", "word"), [(37.47, "No Better"), (38.1, "Better")])
def test_a_refinement_says_what_it_gained(after, word):
    """Catches "Good" of a refinement that gained nothing, and one that does not say what would
    help."""
    first, last = metrics([30.0, 30.0], splats=9)
    lines = report.summarize_continuation(
        [{**first, "psnr_region": 37.44}, {**last, "psnr_region": after}]
    )
    gain = f"37.44 dB before, {after:.2f} dB after ({after - 37.44:+.2f})"
    told = gain if word == "Better" else f"{gain}; {MORE_GAIN}"
    assert f"region: {told}" in [line.replace(" (exposure fitted)", "") for line in lines]
    figures = {"psnr": 37.0, "before_db": 37.44, "after_db": after}
    assert describe_quality(figures) == word
    assert describe_figures(figures)[0] == told


def test_report_of_a_finished_run(toy, tmp_path, monkeypatch):
    """Catches metrics that the summary cannot read, and a missing picture or reason for it."""
    settings = make_settings(iterations=12, hull_points=False, lattice=0)
    run = Run(toy.root, None, "vhap", settings)
    why = f"{CURVE} was not drawn: "
    train_run(toy, tmp_path / "run", run)
    assert report_run(tmp_path / "run")[0].startswith("held-out views: ")
    assert (tmp_path / "run" / CURVE).stat().st_size > 1000
    train_run(replace(toy, views={"train": toy.views["train"]}), tmp_path / "bare", run)
    nothing = "no held-out views (split 'val') were evaluated"
    assert report_run(tmp_path / "bare")[-1] == f"{why}{nothing}"
    (tmp_path / "run" / CURVE).unlink()
    monkeypatch.setattr(report, "find_spec", lambda name: None)
    assert report_run(tmp_path / "run")[-1] == f"{why}matplotlib is not installed"


def test_the_curve_is_drawn_while_training(tmp_path, monkeypatch):
    """Catches a picture only at the end, drawn without need, or that takes more than its
    fraction."""
    now = [0.0]
    drawn = []
    lines = []

    def draw(folder, metrics):
        drawn.append(now[0])
        now[0] += 0.05

    monkeypatch.setattr(report, "perf_counter", lambda: now[0])
    monkeypatch.setattr(report, "write_curve", draw)
    keep = report.CurveUpdater(tmp_path)
    for second in range(51):
        now[0] = float(second)
        if second in (0, 31, 46):
            lines.append({})
        keep(lines)
    assert drawn == [30.0, 36.0, 46.0]


def evaluations(count):
    return [
        {"seconds": 2.0 + n, "psnr": 20.0 + n, "psnr_mask": 18.0, "psnr_moving": 17.0}
        for n in range(count)
    ]


def test_chart_of_a_run():
    """Catches swapped axes, a missing region or forecast, a chart of few evaluations that fails,
    and an axis on which a steep start flattens the rest."""
    lines = evaluations(4)
    lines[-1]["forecast"] = {"seconds": 8.0, "psnr": 24.0, "error": 0.5}
    (axes,) = run_chart(lines).axes
    drawn = {str(line.get_label()): np.asarray(line.get_xydata()) for line in axes.lines}
    assert list(drawn) == ["whole image", "head mask", "moving region", "forecast"]
    assert_array_equal(drawn["whole image"], [[2, 20], [3, 21], [4, 22], [5, 23]])
    assert_array_equal(drawn["forecast"], [[5, 23], [8, 24]])
    band = axes.collections[0].get_paths()[0].vertices
    assert {(8.0, 23.5), (8.0, 24.5)} <= set(map(tuple, band))
    bare = [{"seconds": 2.0, "psnr": 20.0}, {"seconds": 3.0, "psnr": 21.0}]
    for lines in ([], evaluations(1), bare):
        stream = BytesIO()
        run_chart(lines).savefig(stream, format="png")
        picture = Image.open(stream)
        assert picture.size == (900, 540)
        assert np.ptp(np.asarray(picture.convert("L"))) > 200
    lines = [{"seconds": float(s), "psnr": 36 - 30 / s**0.5} for s in (1, 10, 20, 50, 100)]
    (axes,) = run_chart(lines).axes
    assert 25 < axes.get_ylim()[0] < lines[1]["psnr"]


def test_chart_of_a_benchmark():
    """Catches a front or band of another curve, and no chart where a variant was stopped soon."""
    x = np.linspace(1, 10, 50)
    high = MeanCurve(x, np.linspace(29, 30, 50), np.full(50, 28.0), np.full(50, 31.0))
    low = MeanCurve(x, np.full(50, 26.0), np.full(50, 25.9), np.full(50, 26.1))
    (axes,) = benchmark_chart({"high": high, "low": low}, "title").axes
    (bold,) = [line for line in axes.lines if line.get_linewidth() > 3]
    assert np.asarray(bold.get_ydata()).min() >= 29
    for band, curve in zip(axes.collections, (high, low), strict=True):
        vertices = band.get_paths()[0].vertices
        assert (vertices[:, 1].min(), vertices[:, 1].max()) == (curve.low[0], curve.high[0])
    long = np.linspace(1, 100, 50)
    short = np.linspace(1, 5, 5)
    curves = {n: MeanCurve(x, x, x, x) for n, x in (("long", long), ("short", short))}
    (axes,) = benchmark_chart(curves, "title").axes
    assert axes.get_ylim()[0] <= 5


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    """Every preset takes a millisecond an iteration."""
    monkeypatch.setattr(preset_timing, "seconds_per_iteration", lambda *_: 0.001)


def test_presets(toy_root, capsys, monkeypatch):
    """Catches presets without their time, or with the minutes of another device."""
    assert stga("presets", toy_root, "--device cpu") == 0
    device, *lines = capsys.readouterr().out.splitlines()
    assert device == "Training on the CPU (--device cpu)"
    assert [line.split()[0] for line in lines] == ["draft", "standard", "final"]
    assert lines[1].split()[1:6] == ["1900", "iterations", "about", "2", "s"]
    timed = []

    def time(*call):
        timed.append(call[4])
        return 1e-3

    monkeypatch.setattr(preset_timing, "seconds_per_iteration", time)
    for module in ("jobs.analyze", "raster.devices"):
        name = f"stga_addon.{module}.choose_device"
        monkeypatch.setattr(name, lambda wanted: ("gpu:Card", "why"))
    assert stga("presets", toy_root, "--device gpu") == 0
    perform(Analyze(toy_root, device="gpu", timed=True))
    assert timed == ["gpu:Card"] * 6


def test_a_preset_brings_its_iterations(toy_root, tmp_path, capsys, monkeypatch):
    """Catches a preset that changes nothing, and one that cannot be overruled."""
    train = "train", toy_root, "--out"
    assert stga(*train, tmp_path / "preset", "--preset draft --target-psnr 5") == 0
    out = capsys.readouterr().out
    assert "Preset draft: 500 iterations\n" in out
    assert "5 dB was reached" in out
    assert "held-out views: " in out
    settings = read_run(tmp_path / "preset").settings
    assert (settings.preset, settings.iterations) == ("draft", 500)
    assert (settings.lattice, settings.target_psnr) == (1, 5.0)
    assert stga(*train, tmp_path / "counted", "--preset final --iterations 3") == 0
    settings = read_run(tmp_path / "counted").settings
    assert (settings.preset, settings.seconds, settings.iterations) == ("final", None, 3)
