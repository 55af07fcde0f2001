"""The chart's pixels, where curves are known to be."""

from typing import Any

import numpy as np
import pytest
from PIL import Image

from stga_addon.development.benchmark.chart import benchmark_chart
from stga_addon.development.benchmark.statistics import MeanCurve
from stga_addon.report.charts import COLOURS, SIZE, Line, _ticks, chart, run_chart


def pixels_of(image: Image.Image, colour: tuple[int, int, int]) -> np.ndarray:
    """(N, 2) rows and columns of the plot's pixels that are nearly of a colour; the names on the right left out."""
    near = np.abs(np.asarray(image).astype(int) - colour).max(2) < 60
    near[:, SIZE[0] - 200 :] = False
    return np.argwhere(near)


def test_a_straight_line_is_straight_and_rises() -> None:
    """Catches axes that are swapped or upside down."""
    x = np.linspace(0, 10, 50)
    image = chart([Line("a", x, 20 + x)], "title")
    assert image.size == SIZE
    rows, columns = pixels_of(image, COLOURS[0]).T
    slope, _ = np.polyfit(columns, rows, 1)
    assert slope < 0
    assert np.corrcoef(columns, rows)[0, 1] < -0.999
    assert np.ptp(columns) > 0.8 * (SIZE[0] - 264)


def test_the_front_is_bold_and_the_band_around_its_curve() -> None:
    """Catches a front that cannot be seen, and a band of another curve."""
    x = np.linspace(1, 10, 50)
    flat = MeanCurve(x, np.full(50, 30.0), np.full(50, 29.0), np.full(50, 31.0))
    low = MeanCurve(x, np.full(50, 26.0), np.full(50, 25.9), np.full(50, 26.1))
    image = benchmark_chart({"high": flat, "low": low}, "title")
    bold, thin = (pixels_of(image, COLOURS[n]) for n in (0, 1))
    assert bold[:, 0].mean() < thin[:, 0].mean()  # higher in the picture
    middle = SIZE[0] // 3
    assert np.ptp(thin[thin[:, 1] == middle][:, 0]) <= 3
    inside = np.asarray(image)[int(bold[:, 0].mean()) + 15, middle]
    assert (inside < 255).any()
    assert inside[0] < inside[2]  # a pale blue


def test_a_run_of_any_length_can_be_drawn() -> None:
    """Catches a panel that fails before the second evaluation, or on a capture without masks."""
    lines: list[dict[str, Any]] = []
    for n in range(4):
        assert run_chart(lines).size == SIZE
        lines.append({"seconds": 2.0 + n, "psnr": 20.0 + n})
    lines[-1]["forecast"] = {"seconds": 8.0, "psnr": 24.0, "error": 0.5}
    with_masks = [{**line, "psnr_mask": 18.0, "psnr_selected": 17.0} for line in lines]
    for metrics in (lines, with_masks):
        assert run_chart(metrics, (400, 260)).size == (400, 260)
    assert not np.array_equal(np.asarray(run_chart(lines)), np.asarray(run_chart(with_masks)))


@pytest.mark.parametrize(("low", "high"), [(0.0, 180.0), (31.2, 38.9), (0.0, 3.0), (20.0, 20.002)])
def test_ticks_are_round_and_few(low: float, high: float) -> None:
    """Catches a crowded axis, an empty one, and numbers nobody would write."""
    ticks = _ticks(low, high)
    assert 3 <= len(ticks) <= 13
    assert low <= min(ticks)
    assert max(ticks) <= high
    steps = np.diff(ticks)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-6)
    assert round(steps[0] / 10 ** np.floor(np.log10(steps[0]) + 1e-9), 3) in (1, 2, 5)
