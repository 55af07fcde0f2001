"""Means, spreads and fronts against ones computed by hand."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.development.benchmark.benchmark import report_text, table_lines
from stga_addon.development.benchmark.statistics import (
    MeanCurve,
    Outcome,
    mean_curves,
    pareto_front,
    summarize,
)


def line(seconds, psnr, iteration=0, **more):
    values = {"seconds": seconds, "psnr": psnr, "iteration": iteration}
    return values | {"splats": 7, "evaluation_s": 0.5, **more}


def outcome(variant, seed, psnr, finished=True):
    """A run of 10 s and 100 iterations whose curve rises by 1 dB a second to `psnr`."""
    lines = [line(float(s), psnr - 10 + s, 10 * s) for s in range(1, 11)]
    return Outcome(variant, seed, lines, {"val": {"psnr": psnr, "ssim": 0.9}} if finished else {})


def test_mean_curves():
    """Catches seeds averaged by position, and a lead by exposure fitted for one alone."""
    slow = Outcome("a", 0, [line(2.0, 10.0), line(10.0, 18.0)], {})
    fast = Outcome("a", 1, [line(1.0, 11.0), line(5.0, 15.0), line(9.0, 19.0)], {})
    curve = mean_curves([slow, fast, Outcome("b", 0, [line(1.0, 5.0)], {})])["a"]
    assert (curve.seconds[0], curve.seconds[-1]) == (2.0, 9.0)
    assert_allclose(curve.low, curve.seconds + 8)
    assert_allclose(curve.high, curve.seconds + 10)
    assert_allclose(curve.mean, curve.seconds + 9)
    fitted = Outcome("a", 0, [line(s, 35.0, psnr_unmatched=28.0) for s in (1.0, 5.0)], {})
    curves = mean_curves([fitted, Outcome("b", 0, [line(s, 30.0) for s in (1.0, 5.0)], {})])
    assert_allclose(curves["a"].mean, 28.0)
    assert [name for name, *_ in pareto_front(curves)] == ["b"]


def curve(seconds, psnr):
    values = np.array(psnr)
    return MeanCurve(np.array(seconds), values, values, values)


def test_the_front():
    """Catches a variant on the front that another beat earlier, and time on it without any gain."""
    curves = {
        "early": curve([1, 2, 10], [20, 30, 30]),
        "late": curve([1, 10], [20, 38]),
        "never": curve([1, 10], [15, 29]),
    }
    (first, a, b), (second, c, d) = pareto_front(curves)
    assert (first, second) == ("early", "late")
    assert a == 1
    assert b == pytest.approx(2, abs=0.05)  # after that it only waits
    assert c == pytest.approx(6, abs=0.05)  # where the late one has caught up with 30 dB
    assert d == 10
    assert pareto_front({}) == []


def test_the_report():
    """Catches figures under a wrong heading, unnamed fits, and a ranking that seeds do not bear
    out."""
    runs = [
        outcome(name, seed, psnr + seed)
        for name, psnr in (("standard", 30.0), ("draft", 27.0))
        for seed in (0, 1)
    ]
    lines = table_lines(summarize(runs))
    assert len({len(text) for text in lines}) == 1
    cells = [[cell.strip() for cell in text.strip("|").split("|")] for text in lines]
    assert cells[0] == ["variant", "iterations", "ms/it", "splats", "val", "SSIM", "Δ val"]
    assert cells[2] == ["standard", "100", "100.0", "7", "30.50±0.71", "0.9000±0.0000", "+0.00"]
    assert cells[3][-1] == "-3.00"
    val = {"psnr": 35.0, "psnr_unmatched": 28.0, "ssim": 0.9}
    runs = [Outcome("a", 0, [line(1.0, 35.0, 1)], {"val": val})]
    heading = table_lines(summarize(runs))[0]
    assert [cell.strip() for cell in heading.strip("|").split("|")][4:6] == ["val", "val unfitted"]
    assert "The exposure of held-out cameras is fitted for all variants" in report_text(
        runs, {}, 1.0, Path("head")
    )
    two = [
        outcome(name, seed, psnr + seed)
        for name, psnr in (("a", 30.0), ("b", 30.5), ("c", 20.0))
        for seed in (0, 1)
    ]
    text = report_text(two, mean_curves(two), 10.0, Path("head"))
    assert "b and a are 0.50 dB apart, which is within their spread" in text
    assert "a and c" not in text
    assert "Pareto front of PSNR over time: b 1 s–10 s" in text
    assert "Evaluation while training took 45.0%" in text
    one = [run for run in two if run.seed == 0]
    assert "One seed gives no spread" in report_text(one, mean_curves(one), 10.0, Path("head"))
    none = [outcome("a", 0, 30.0, finished=False)]
    assert report_text(none, {}, 10.0, Path("head")) == "head: no run is finished yet"
