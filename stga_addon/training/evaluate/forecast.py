"""What more time will bring: a curve of held-out PSNR over training time, continued with an error that is earned."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

Curve = Sequence[tuple[float, float]]
"""(seconds of training, PSNR in dB) of each evaluation, ascending."""

FEWEST = 4
"""Evaluations before which nothing is said."""
LATE = 2 / 3
"""Only evaluations since this share of the time are continued: what came before was another phase."""
TRUE = 0.8
"""Share of the forecasts that should come true within their error."""
DOUBT = 0.8
"""Error of a forecast that nothing is known about, as a share of the gain that it promises."""
RESOLUTION = 0.05
"""dB: evaluations scatter by about this much."""
HORIZONS = (5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600)
"""Seconds that a forecast may look ahead."""
STILL = 0.02
"""dB: a smaller gain is none."""
LEAST = 0.2
"""Of what a curve will ever gain, this share must be left at a target to call it in reach: with less, it would take 25
times as long as was trained."""
SOON = 1.1
"""Times the time trained that a target takes at least which the scatter alone kept from being reached."""


@dataclass(frozen=True)
class Forecast:
    """PSNR ± error in dB at `seconds` of training, `ahead` seconds after it was made, `gain` dB more than then."""

    seconds: float
    psnr: float
    error: float
    ahead: float
    gain: float

    def as_json(self) -> dict[str, float]:
        return {name: round(value, 4) for name, value in asdict(self).items()}

    def __str__(self) -> str:
        return f"another {clock(self.ahead)}: about {self.gain:+.1f} dB (±{self.error:.1f})"


def forecast(curve: Curve, ahead: float) -> Forecast | None:
    """Where the curve will be `ahead` seconds after its end; None where it is too short to tell.

    The model is PSNR = a − b/√t, which levels off at a, laid through the late evaluations by the median of the slopes
    between them, so that a single bad one does not tilt it. Its error is how far off the forecasts would have been
    that earlier evaluations gave over the same span in proportion, in units of the gain that each promised and of the
    scatter; one that was off by DOUBT counts among them, so that a lucky start does not look like knowledge.
    """
    if len(curve) < FEWEST:
        return None
    t, psnr = np.array(curve, np.float64).T
    if not (t[0] > 0 and (np.diff(t) > 0).all() and np.isfinite(psnr).all()):
        return None
    reach = 1 + ahead / t[-1]
    now, gain, scatter = _continued(t, psnr, reach)
    past = [n for n in range(FEWEST, len(t)) if reach * t[n - 1] <= t[-1]]
    misses = [DOUBT]
    for n in past:
        then, promised, _ = _continued(t[:n], psnr[:n], reach)
        came = float(np.interp(reach * t[n - 1], t, psnr))
        misses.append(abs(then + promised - came) / (abs(promised) + scatter))
    error = float(np.quantile(misses, TRUE, method="higher")) * (abs(gain) + scatter)
    return Forecast(float(t[-1] + ahead), now + gain, max(error, RESOLUTION), ahead, gain)


def horizon(elapsed: float, left: float) -> float | None:
    """How far ahead to look: a round time, within the budget, at most half of what was seen; None if too little."""
    fitting = [ahead for ahead in HORIZONS if ahead <= min(left, elapsed / 2)]
    return float(fitting[-1]) if fitting else None


def level_since(curve: Curve) -> float | None:
    """The time of the best evaluation, if more time no longer helps: the last third of the time, and at least four
    evaluations, brought nothing over it. None while it still rises."""
    t, psnr = np.array(curve, np.float64).reshape(-1, 2).T
    late = np.flatnonzero(t > LATE * t[-1:])
    if len(late) < FEWEST or len(late) == len(t):
        return None
    before = psnr[: late[0]]
    return float(t[np.argmax(before)]) if psnr[late].max() < before.max() + STILL else None


def hits(lines: Sequence[Mapping[str, Any]]) -> tuple[int, int]:
    """How many forecasts of a metrics.jsonl came true within their error, and how many could be checked.

    The curve is taken as straight between evaluations.
    """
    curve = curve_of(lines)
    if not curve:
        return 0, 0
    t, psnr = np.array(curve, np.float64).T
    made = [line["forecast"] for line in lines if "forecast" in line]
    due = [f for f in made if f["seconds"] <= t[-1]]
    came_true = [abs(np.interp(f["seconds"], t, psnr) - f["psnr"]) <= f["error"] for f in due]
    return int(sum(came_true)), len(due)


def curve_of(lines: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """The curve in a metrics.jsonl; an evaluation at the same moment as the one before it is left out."""
    curve: list[tuple[float, float]] = []
    for line in lines:
        if "psnr" in line and (not curve or line["seconds"] > curve[-1][0]):
            curve.append((line["seconds"], line["psnr"]))
    return curve


def missed(curve: Curve, target: float) -> str:
    """Why a target PSNR was not reached, in one sentence."""
    best = max(psnr for _, psnr in curve)
    lead = f"{target:g} dB was not reached (best {best:.2f} dB)"
    level = level_since(curve)
    if level is not None:
        return f"{lead}: nothing was gained after {clock(level)}, so more time would not help; more splats may"
    if len(curve) < FEWEST:
        return f"{lead}: there are too few evaluations to say how long it would take"
    t, psnr = np.array(curve, np.float64).T
    now, gain, _ = _continued(t, psnr, np.inf)
    if gain <= 0:
        return f"{lead}: the curve does not rise steadily"
    left = 1 - (target - now) / gain  # share of the gain that is still to come once the target is reached
    if left < LEAST:
        beyond = target > now + (1 + DOUBT) * gain
        says = "more time alone would not reach it" if beyond else "only a much longer budget might reach it"
        return f"{lead}: the curve levels off at about {now + gain:.1f} dB; {says}"
    reach = max(left**-2, SOON)
    return f"{lead}: as the curve goes, it would take about {clock((reach - 1) * t[-1])} more"


def clock(seconds: float) -> str:
    """ "45 s", "2 min", "1 h 30 min"."""
    whole = round(seconds)
    if whole < 100:
        return "1 min" if whole == 60 else f"{whole} s"
    minutes = round(whole / 60)
    if minutes < 100:
        return f"{minutes} min" if minutes * 60 == whole or whole > 600 else f"{whole / 60:.1f} min"
    return f"{minutes // 60} h {minutes % 60} min"


def _continued(t: np.ndarray, psnr: np.ndarray, reach: float) -> tuple[float, float, float]:
    """The model's value at t[-1], its gain from there to reach·t[-1] (slope after Theil and Sen), and the scatter of
    the evaluations around it."""
    late = np.arange(len(t)) >= min(np.searchsorted(t, LATE * t[-1]), len(t) - FEWEST)
    x, y = -np.sqrt(t[-1] / t[late]), psnr[late]
    first, second = np.triu_indices(len(x), 1)
    slope = float(np.median((y[second] - y[first]) / (x[second] - x[first])))
    levels = y - slope * (x + 1)
    now = float(np.median(levels))
    scatter = max(2 * RESOLUTION, 3 * float(np.median(np.abs(levels - now))))
    return now, slope * (1 - reach**-0.5), scatter
