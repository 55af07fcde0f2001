"""Forecast of held-out quality from the evaluations of a run so far."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ...format import format_duration
from ..settings import CONTINUATIONS, TrainingSettings

Curve = Sequence[tuple[float, float]]
"""(seconds of training, PSNR in dB) of each evaluation, ascending."""

DETAIL = "detail_difference"
"""Key, in a metrics.jsonl, of what the avatar that a run keeps is chosen by; lower is better."""
MIN_DETAIL = 1e-6
"""Smaller detail differences are rounding."""
FITTED_HEADS = "_fitted_heads"
"""Ending of keys of quality with the heads of unseen timesteps fitted by the avatar, to the images
that it is measured by; without it, heads are as tracked."""
UNMATCHED = "psnr_unmatched"
"""Key of PSNR without fitted exposure, in the lines whose "psnr" is with it."""
MIN_EVALUATIONS = 4
"""Evaluations that a forecast needs."""
FITTED_SINCE_FRACTION = 2 / 3
"""The fit uses evaluations since this fraction of the time: before, the phase is a steeper one."""
FORECAST_CONFIDENCE = 0.8
"""Fraction of forecasts that should hold within their error."""
PRIOR_RELATIVE_ERROR = 0.8
"""Error of a forecast without earlier ones to check, as a fraction of the gain that it promises."""
EVALUATION_NOISE_DB = 0.05
"""Typical scatter between evaluations."""
HORIZONS_S = (5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600)
"""Time spans that a forecast may look ahead."""
MIN_GAIN_DB = 0.02
"""Smaller gains count as none."""
MIN_REMAINING_FRACTION = 0.2
"""A target is called reachable if at least this fraction of the total predicted gain lies beyond
it; with less, reaching it would take more than 25 times the time trained."""
MIN_TIME_FACTOR = 1.1
"""Lower bound of the predicted time to a target, as a multiple of the time trained; applies where
the fit already lies above the target but no evaluation does."""


@dataclass(frozen=True)
class Forecast:
    """PSNR ± error in dB at `seconds` of training, `ahead` after the forecast; `gain` in dB."""

    seconds: float
    psnr: float
    error: float
    ahead: float
    gain: float

    def as_json(self) -> dict[str, float]:
        return {name: round(value, 4) for name, value in asdict(self).items()}

    def __str__(self) -> str:
        ahead = format_duration(self.ahead)
        return f"another {ahead}: about {self.gain:+.1f} dB (±{self.error:.1f})"


def forecast(curve: Curve, ahead: float) -> Forecast | None:
    """Predict the curve `ahead` seconds after its end, by PSNR = a − b/√t; None if it is too short.

    The error is that of the same forecast from earlier evaluations, relative to the predicted gain
    plus the scatter; PRIOR_RELATIVE_ERROR counts as one of them.
    """
    if not _can_fit(curve):
        return None
    t, psnr = np.array(curve, np.float64).T
    factor = 1 + ahead / t[-1]
    now, gain, scatter = _fit(t, psnr, factor)
    past = [n for n in range(MIN_EVALUATIONS, len(t)) if factor * t[n - 1] <= t[-1]]
    errors = [PRIOR_RELATIVE_ERROR]
    for n in past:
        then, predicted_gain, _ = _fit(t[:n], psnr[:n], factor)
        actual = float(np.interp(factor * t[n - 1], t, psnr))
        errors.append(abs(then + predicted_gain - actual) / (abs(predicted_gain) + scatter))
    error = float(np.quantile(errors, FORECAST_CONFIDENCE, method="higher")) * (abs(gain) + scatter)
    return Forecast(float(t[-1] + ahead), now + gain, max(error, EVALUATION_NOISE_DB), ahead, gain)


def forecast_horizon(elapsed: float, left: float) -> float | None:
    """Longest of HORIZONS_S within `left` and half of `elapsed` (seconds); None if none fits."""
    fitting = [ahead for ahead in HORIZONS_S if ahead <= min(left, elapsed / 2)]
    return float(fitting[-1]) if fitting else None


def plateau_start(curve: Curve) -> float | None:
    """Time of the best evaluation if PSNR has stopped rising, else None: at least MIN_EVALUATIONS
    in the last third of the time gained less than MIN_GAIN_DB."""
    t, psnr = np.array(curve, np.float64).reshape(-1, 2).T
    late = np.flatnonzero(t > FITTED_SINCE_FRACTION * t[-1:])
    if len(late) < MIN_EVALUATIONS or len(late) == len(t):
        return None
    before = psnr[: late[0]]
    return float(t[np.argmax(before)]) if psnr[late].max() < before.max() + MIN_GAIN_DB else None


def checked_forecasts(lines: Sequence[Mapping[str, Any]]) -> tuple[int, int]:
    """How many forecasts of a metrics.jsonl held within their error, and how many were checked."""
    curve = curve_of(lines)
    if not curve:
        return 0, 0
    t, psnr = np.array(curve, np.float64).T
    made = [line["forecast"] for line in lines if "forecast" in line]
    checked = [f for f in made if f["seconds"] <= t[-1]]
    held = [abs(np.interp(f["seconds"], t, psnr) - f["psnr"]) <= f["error"] for f in checked]
    return int(sum(held)), len(checked)


def is_exposure_fitted(lines: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the PSNR of a metrics.jsonl is with the exposure of untrained cameras fitted."""
    return any(UNMATCHED in line for line in lines)


def quality_score(line: Mapping[str, Any]) -> float:
    """dB of PSNR and of detail (`detail_curve`) together, by which states of a run are ranked: one
    that another beats in both is never ahead of it. −∞ where they are not numbers."""
    score = float(line["psnr"])
    if DETAIL in line:
        score -= 20 * math.log10(max(float(line[DETAIL]), MIN_DETAIL))
    return -math.inf if math.isnan(score) else score


def kept_line(lines: Sequence[Mapping[str, Any]], settings: TrainingSettings) -> Mapping[str, Any]:
    """The line, of those with a PSNR, of the avatar that a run with these settings keeps.

    A continuation keeps the latest: the one before is in the folder that it continues. Others keep
    the last that reached the target, which ends the run, or else the one of highest
    `quality_score`. PSNR alone prefers an early, blurred state to detail that is a pixel off;
    sharpness alone one with haze beside the head.
    """
    target = settings.target_psnr
    if settings.strategy in CONTINUATIONS:
        return lines[-1]
    reached = [line for line in lines if target is not None and line["psnr"] >= target]
    return reached[-1] if reached else max(reversed(lines), key=quality_score)


def curve_of(lines: Sequence[Mapping[str, Any]], key: str = "psnr") -> list[tuple[float, float]]:
    """(seconds, value of `key`) of evaluations, without repeated times or values not finite."""
    curve: list[tuple[float, float]] = []
    for line in lines:
        if key in line and np.isfinite(line[key]) and (not curve or line["seconds"] > curve[-1][0]):
            curve.append((line["seconds"], line[key]))
    return curve


def detail_curve(lines: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """(seconds, −20·log10 of the detail difference): dB like PSNR, higher is sharper."""
    return [(t, -20 * np.log10(value)) for t, value in curve_of(lines, DETAIL) if value > 0]


def flat_since(lines: Sequence[Mapping[str, Any]]) -> float | None:
    """Seconds since when nothing was gained, neither PSNR nor detail, which may rise alone late in
    a run; None while one of them rises."""
    curves = [curve for curve in (curve_of(lines), detail_curve(lines)) if curve]
    starts = [start for start in map(plateau_start, curves) if start is not None]
    return max(starts) if starts and len(starts) == len(curves) else None


def forecast_text(lines: Sequence[Mapping[str, Any]], ahead: float) -> str:
    """What `ahead` more seconds would bring, in PSNR and detail difference; empty if unknown."""
    predicted = forecast(curve_of(lines), ahead)
    detail = forecast(detail_curve(lines), ahead)
    if predicted is None:
        return ""
    text = f"{predicted} PSNR with exposure fitted" if is_exposure_fitted(lines) else str(predicted)
    if detail is None:
        return text
    change, error = (100 * (10 ** (-gain / 20) - 1) for gain in (detail.gain, -detail.error))
    return f"{text}, detail difference {change:+.0f} % (±{error:.0f})"


def describe_forecast(
    lines: Sequence[Mapping[str, Any]], elapsed: float, left: float, target: float | None
) -> str:
    """What to expect of the remaining budget `left` (seconds) after `elapsed`, and whether a target
    PSNR is in reach; empty where nothing is known."""
    ahead = forecast_horizon(elapsed, left)
    text = "" if ahead is None else forecast_text(lines, ahead)
    plateau = flat_since(lines) if left else None
    if plateau is not None:
        text = f"no gain since {format_duration(plateau)}: more time no longer helps"
    end = forecast(curve_of(lines), left) if left else None
    if target is not None and end is not None and end.psnr + end.error < target:
        fitted = ", exposure fitted" if is_exposure_fitted(lines) else ""
        expected = f"{end.psnr:.1f} ± {end.error:.1f} dB at the end{fitted}"
        far = f"{target:g} dB is out of reach ({expected})"
        text = "; ".join(filter(None, (text, far)))
    return text


def explain_missed_target(curve: Curve, target: float) -> str:
    """Why a target PSNR was not reached and what would help, in one sentence."""
    best = max(psnr for _, psnr in curve)
    missed = f"{target:g} dB was not reached (best {best:.2f} dB)"
    plateau = plateau_start(curve)
    if plateau is not None:
        return (
            f"{missed}: nothing was gained after {format_duration(plateau)}, so more time "
            "would not help; more splats may"
        )
    if not _can_fit(curve):
        return f"{missed}: there are too few evaluations to say how long it would take"
    t, psnr = np.array(curve, np.float64).T
    now, gain, _ = _fit(t, psnr, np.inf)
    if gain <= 0:
        return f"{missed}: the curve does not rise steadily"
    remaining = 1 - (target - now) / gain  # fraction of the total gain that lies beyond the target
    if remaining < MIN_REMAINING_FRACTION:
        advice = "only a much longer budget might reach it"
        if target > now + (1 + PRIOR_RELATIVE_ERROR) * gain:
            advice = "more time alone would not reach it"
        return f"{missed}: the curve levels off at about {now + gain:.1f} dB; {advice}"
    factor = max(remaining**-2, MIN_TIME_FACTOR)
    more = format_duration((factor - 1) * t[-1])
    return f"{missed}: extrapolating the curve, it would take about {more} more"


def _can_fit(curve: Curve) -> bool:
    if len(curve) < MIN_EVALUATIONS:
        return False
    t, psnr = np.array(curve, np.float64).T
    return bool(t[0] > 0 and (np.diff(t) > 0).all() and np.isfinite(psnr).all())


def _fit(t: np.ndarray, psnr: np.ndarray, factor: float) -> tuple[float, float, float]:
    """The model's PSNR at t[-1], its gain from there to factor·t[-1], and the scatter of the
    evaluations around it; the slope is the Theil–Sen estimator, robust to outliers."""
    first_late = np.searchsorted(t, FITTED_SINCE_FRACTION * t[-1])
    late = slice(min(int(first_late), len(t) - MIN_EVALUATIONS), None)
    x = -np.sqrt(t[-1] / t[late])
    y = psnr[late]
    first, second = np.triu_indices(len(x), 1)
    slope = float(np.median((y[second] - y[first]) / (x[second] - x[first])))
    levels = y - slope * (x + 1)
    now = float(np.median(levels))
    scatter = max(2 * EVALUATION_NOISE_DB, 3 * float(np.median(np.abs(levels - now))))
    return now, slope * (1 - factor**-0.5), scatter
