"""Charts of a run and of a benchmark."""

from io import BytesIO
from typing import Any

import numpy as np
from PIL import Image

from stga_addon.development.benchmark.benchmark import benchmark_chart
from stga_addon.development.benchmark.statistics import MeanCurve
from stga_addon.report import run_chart


def evaluations(count: int) -> list[dict[str, Any]]:
    return [
        {"seconds": 2.0 + n, "psnr": 20.0 + n, "psnr_mask": 18.0, "psnr_moving": 17.0}
        for n in range(count)
    ]


def test_run_chart_shows_regions_and_the_forecast() -> None:
    """Catches swapped axes, a missing region, and a forecast that does not start at the latest
    evaluation."""
    lines = evaluations(4)
    lines[-1]["forecast"] = {"seconds": 8.0, "psnr": 24.0, "error": 0.5}
    (axes,) = run_chart(lines).axes
    drawn = {str(line.get_label()): np.asarray(line.get_xydata()) for line in axes.lines}
    assert list(drawn) == ["whole image", "head mask", "moving region", "forecast"]
    np.testing.assert_array_equal(drawn["whole image"], [[2, 20], [3, 21], [4, 22], [5, 23]])
    np.testing.assert_array_equal(drawn["forecast"], [[5, 23], [8, 24]])
    band = axes.collections[0].get_paths()[0].vertices
    assert {(8.0, 23.5), (8.0, 24.5)} <= set(map(tuple, band))


def test_a_run_of_any_length_is_rendered() -> None:
    """Catches a chart that fails before the second evaluation, or on a capture without masks, and
    an empty picture."""
    for lines in (
        [],
        evaluations(1),
        [{"seconds": 2.0, "psnr": 20.0}, {"seconds": 3.0, "psnr": 21.0}],
    ):
        stream = BytesIO()
        run_chart(lines).savefig(stream, format="png")
        picture = Image.open(stream)
        assert picture.size == (900, 540)
        assert np.ptp(np.asarray(picture.convert("L"))) > 200


def test_the_steep_start_is_cut_off() -> None:
    """Catches an axis on which the first evaluation of a long run flattens all others."""
    lines = [{"seconds": float(s), "psnr": 36 - 30 / s**0.5} for s in (1, 10, 20, 50, 100)]
    (axes,) = run_chart(lines).axes
    assert 25 < axes.get_ylim()[0] < lines[1]["psnr"]


def test_a_curve_that_ends_before_a_tenth_of_the_time() -> None:
    """Catches a benchmark without a chart because one of its variants was stopped soon."""
    long, short = np.linspace(1, 100, 50), np.linspace(1, 5, 5)
    curves = {n: MeanCurve(x, x, x, x) for n, x in (("long", long), ("short", short))}
    (axes,) = benchmark_chart(curves, "title").axes
    assert axes.get_ylim()[0] <= 5


def test_the_pareto_front_is_bold_and_bands_belong_to_their_curves() -> None:
    """Catches a front on the wrong curve, and a band of another variant or color."""
    x = np.linspace(1, 10, 50)
    high = MeanCurve(x, np.linspace(29, 30, 50), np.full(50, 28.0), np.full(50, 31.0))
    low = MeanCurve(x, np.full(50, 26.0), np.full(50, 25.9), np.full(50, 26.1))
    (axes,) = benchmark_chart({"high": high, "low": low}, "title").axes
    (bold,) = [line for line in axes.lines if line.get_linewidth() > 3]
    assert np.asarray(bold.get_ydata()).min() >= 29
    for band, curve, name in zip(axes.collections, (high, low), ("high", "low"), strict=True):
        vertices = band.get_paths()[0].vertices
        assert (vertices[:, 1].min(), vertices[:, 1].max()) == (curve.low[0], curve.high[0])
        (line,) = [line for line in axes.lines if line.get_label() == name]
        assert band.get_facecolor()[0, :3].tolist() == [
            int(str(line.get_color())[n : n + 2], 16) / 255 for n in (1, 3, 5)
        ]
