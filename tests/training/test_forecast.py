"""What a run says about more time, against curves whose future is known."""

from dataclasses import replace

import numpy as np
import pytest

from stga_addon.training.evaluate.forecast import (
    MIN_EVALUATIONS,
    Forecast,
    checked_forecasts,
    detail_curve,
    explain_missed_target,
    flat_since,
    forecast,
    forecast_text,
    kept_line,
    plateau_start,
)
from stga_addon.training.settings import make_settings

TIMES = np.arange(1, 31) * 4.0


def rising(times, noise=0.0, seed=0):
    """Levels off at 36 dB."""
    return 36 - 20 / np.sqrt(times) + np.random.default_rng(seed).normal(0, noise, len(times))


def curve(times, psnr):
    return list(zip(times.tolist(), psnr.tolist(), strict=True))


def test_a_curve_of_the_models_own_kind_is_continued_exactly():
    """Catches another span or slope than the curve's, an outlier that tilts it, and its error."""
    for count in (MIN_EVALUATIONS, 9, 20):
        seen = curve(TIMES[:count], rising(TIMES[:count]))
        for ahead in (5.0, 30.0):
            told = forecast(seen, ahead)
            end = TIMES[count - 1] + ahead
            assert told.seconds == end
            assert told.psnr == pytest.approx(float(rising(np.array([end]))[0]), abs=1e-6)
            assert told.gain == pytest.approx(told.psnr - seen[-1][1], abs=1e-6)
    psnr = rising(TIMES)
    psnr[-3] -= 2
    told = forecast(curve(TIMES, psnr), 20.0)
    assert told.psnr == pytest.approx(float(rising(TIMES[-1:] + 20)[0]), abs=0.1)
    calm, wild = (forecast(curve(TIMES, rising(TIMES, noise)), 20.0) for noise in (0.0, 0.5))
    assert calm.error < 0.3 < wild.error


@pytest.mark.parametrize("noise", [0.03, 0.1])
def test_four_of_five_forecasts_come_true(noise):
    """Catches an error that is too small to be honest or too large to say anything."""
    misses = []
    errors = []
    for seed in range(30):
        psnr = rising(TIMES, noise, seed)
        for count in range(8, 24):
            told = forecast(curve(TIMES[:count], psnr[:count]), 16.0)
            misses.append(abs(told.psnr - psnr[count + 3]))
            errors.append(told.error)
    assert 0.7 < np.mean(np.array(misses) <= errors) < 0.95
    assert np.median(errors) < 3 * np.median(misses)


@pytest.mark.filterwarnings("error")
def test_nothing_is_said_too_early_or_of_nonsense():
    """Catches a division by nothing, even its warning, and forecasts from two points."""
    assert forecast([], 10.0) is None
    assert forecast(curve(TIMES[:3], rising(TIMES[:3])), 10.0) is None
    assert forecast([(1.0, 20.0), (2.0, 21.0), (2.0, 22.0), (3.0, 23.0)], 10.0) is None
    assert forecast([(1.0, 20.0), (2.0, np.nan), (3.0, 22.0), (4.0, 23.0)], 10.0) is None
    assert forecast([(0.0, 20.0), (2.0, 21.0), (3.0, 22.0), (4.0, 23.0)], 10.0) is None
    same = forecast([(float(t), 30.0) for t in range(1, 9)], 4.0)
    assert (same.gain, same.psnr) == (0.0, 30.0)
    seconds = np.arange(5.0)
    assert forecast(curve(seconds, seconds + 20), 5.0) is None
    assert "too few evaluations" in explain_missed_target(curve(seconds, seconds + 20), 40)


def evaluations(psnr, detail):
    rows = zip(TIMES.tolist(), psnr.tolist(), detail.tolist(), strict=True)
    return [{"seconds": s, "psnr": p, "detail_difference": d} for s, p, d in rows]


def test_a_run_is_flat_when_neither_measure_rises():
    """Catches a run called finished while PSNR or detail rises, and one that falls and is not."""
    fell = np.where(TIMES < 50, rising(TIMES), 30.0)
    sharper = 0.1 / np.sqrt(TIMES)
    assert flat_since(evaluations(fell, sharper)) is None
    assert flat_since(evaluations(fell, np.where(TIMES < 30, sharper, 0.05))) == 48.0
    assert flat_since([{"seconds": s, "psnr": p} for s, p in curve(TIMES, fell)]) == 48.0
    assert flat_since([]) is None
    assert plateau_start(curve(TIMES, rising(TIMES))) is None
    fell = np.where(TIMES < 50, rising(TIMES), rising(np.array([48.0])) - (TIMES - 50) / 100)
    assert plateau_start(curve(TIMES, fell)) == 48.0
    assert plateau_start(curve(TIMES[:12], fell[:12])) is None
    assert plateau_start([]) is None
    assert plateau_start(curve(TIMES[:3], np.full(3, 30.0))) is None


def test_forecast_of_both_measures():
    """Catches a detail difference forecast in dB, upwards, or where it is not measured."""
    lines = evaluations(rising(TIMES), 10 ** (-(30 - 20 / np.sqrt(TIMES)) / 20))
    assert detail_curve(lines)[-1][1] == pytest.approx(30 - 20 / np.sqrt(120))
    gain = 20 / np.sqrt(120) - 20 / np.sqrt(240)
    percent = 100 * (10 ** (-gain / 20) - 1)
    text = forecast_text(lines, 120.0)
    assert text.startswith(f"another 2 min: about +{gain:.1f} dB")
    assert f", detail difference {percent:.0f} % (±" in text
    only_psnr = [{"seconds": line["seconds"], "psnr": line["psnr"]} for line in lines]
    assert "detail" not in forecast_text(only_psnr, 120.0)
    assert forecast_text([], 120.0) == ""


def test_hits():
    """Catches forecasts counted too early, or compared with the wrong moment."""

    def told(seconds, psnr):
        return Forecast(seconds, psnr, 0.2, 10.0, 0.0).as_json()

    lines = [
        {"seconds": 10.0, "psnr": 30.0, "forecast": told(15.0, 31.1)},  # 31.0 came: true
        {"seconds": 20.0, "psnr": 32.0, "forecast": told(30.0, 32.5)},  # 33.0 came: false
        {"seconds": 30.0, "psnr": 33.0, "forecast": told(40.0, 33.0)},  # not yet known
    ]
    assert checked_forecasts(lines) == (1, 2)
    assert checked_forecasts([]) == (0, 0)
    assert checked_forecasts([{"seconds": 1.0}]) == (0, 0)


def test_why_a_target_was_missed():
    """Catches "train longer" where that is no help, and another time than it will take."""
    risen = curve(TIMES, rising(TIMES))  # in 120 s; 36 − 20/√400 = 35
    assert explain_missed_target(risen, 35).endswith(
        "extrapolating the curve, it would take about 4.7 min more"
    )
    assert explain_missed_target(risen, 34.18).endswith("would take about 12 s more")
    assert explain_missed_target(risen, 40).endswith(
        "levels off at about 36.0 dB; more time alone would not reach it"
    )
    assert explain_missed_target([(1.0, 20.0)], 40) == (
        "40 dB was not reached (best 20.00 dB): there are too few evaluations to say how long it "
        "would take"
    )


def test_no_state_is_kept_that_another_beats_in_both_figures():
    """Catches a rule by pairs, under which a run creeps from its best state to one that is both
    more blurred and of lower PSNR, and a report of another state than the one that was written."""
    rng = np.random.default_rng(0)
    settings = make_settings(iterations=1)
    for _ in range(500):
        states = [
            {"psnr": psnr, "detail_difference": detail}
            for psnr, detail in zip(rng.normal(25, 1, 12), rng.uniform(0.1, 0.4, 12), strict=True)
        ]
        written = states[0]
        for count in range(1, len(states) + 1):
            kept = kept_line(states[:count], settings)
            written = kept if kept is states[count - 1] else written
            assert kept is written
        for state in states:
            beaten = state["psnr"] > kept["psnr"]
            assert not (beaten and state["detail_difference"] < kept["detail_difference"])
    blurred, sharp = ({"psnr": 25.0, "detail_difference": d} for d in (0.3, 0.2))
    assert kept_line([sharp, blurred], settings) is sharp
    assert kept_line([sharp, {**sharp, "psnr": 25.1}, blurred], settings)["psnr"] == 25.1
    lost = {"psnr": float("nan"), "detail_difference": 0.1}
    assert kept_line([lost, blurred, lost], settings) is blurred
    for strategy in ("refine", "extend"):
        assert kept_line([sharp, blurred], replace(settings, strategy=strategy)) is blurred
