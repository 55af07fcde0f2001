"""Evaluations of a run while it trains: when they are due, what is kept, and when to stop."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...capture.model import View, ViewExposure
from ..settings import TrainingSettings
from .forecast import (
    curve_of,
    describe_forecast,
    flat_since,
    forecast,
    forecast_horizon,
    kept_line,
)
from .metrics import EvaluationView, Quality, evaluate

EVALUATIONS = 10
"""Evaluations over a budget in iterations, at fixed fractions of it, so that runs are
reproducible."""
EVALUATION_FRACTION = 0.04
"""Largest fraction that evaluations, without the last one, add to a budget in seconds."""
MAX_EVALUATIONS = 40
"""Evaluations over a budget in seconds, even where they cost little."""
RENDERING_COST = 0.5
"""Time to render a view, as a fraction of the time to train it; estimates the first evaluation."""


@dataclass(frozen=True)
class Spent:
    """Trained so far: fraction of the budget (may exceed 1), seconds without evaluations, steps;
    the seconds of training that are left, at the speed so far, NaN before the first step."""

    fraction: float
    seconds: float
    iterations: int
    left_s: float


@dataclass
class Evaluator:
    """Evaluates a run's avatar on its evaluation views, and remembers what was found.

    keeps_latest     whatever `kept_line` says, as where the avatars before are lost
    lines            of the run's metrics.jsonl
    exposure         `known_exposure` of the training cameras; None where their images are not
                     corrected
    count            evaluations of the schedule that have been made
    forecast_text    what more training is expected to bring
    """

    settings: TrainingSettings
    views: Sequence[EvaluationView]
    keeps_latest: bool = False
    exposure: ViewExposure | None = None
    lines: list[dict[str, Any]] = field(default_factory=list)
    count: int = 0
    forecast_text: str = ""

    def is_due(self, spent: Spent) -> bool:
        """Whether to evaluate now; at the end of the budget there is an evaluation anyway."""
        budget_s = self.settings.seconds
        if spent.fraction >= 1 or budget_s is None:
            return 1 > spent.fraction >= (self.count + 1) / EVALUATIONS
        cost = RENDERING_COST * len(self.views) * spent.seconds / spent.iterations
        last = 0.0
        if self.lines:
            cost = float(self.lines[-1]["evaluation_s"])
            last = float(self.lines[-1]["seconds"])
        return spent.seconds - last >= max(budget_s / MAX_EVALUATIONS, cost / EVALUATION_FRACTION)

    def is_finished(self, spent: Spent) -> bool:
        """Whether the budget is spent, the target reached, or a stop at a flat curve due."""
        target = self.settings.target_psnr
        reached = target is not None and any(psnr >= target for _, psnr in curve_of(self.lines))
        if spent.fraction >= 1 or reached:
            return True
        return self.settings.stop_when_flat and flat_since(self.lines) is not None

    def measure(self, render: Callable[[View], np.ndarray], perceptual: bool = False) -> Quality:
        """Quality of `render(view)` on the evaluation views; perceptual: with LPIPS."""
        return evaluate(render, self.views, perceptual, self.exposure)

    def evaluate(
        self, render: Callable[[View], np.ndarray], perceptual: bool = False
    ) -> tuple[dict[str, float], bool]:
        """Fields of a metrics line (`measure`), and whether the avatar is to be kept
        (`kept_line`)."""
        if not self.views:
            return {}, True
        quality = self.measure(render, perceptual).as_json()
        scored = [line for line in self.lines if "psnr" in line]
        is_kept = kept_line([*scored, quality], self.settings) is quality
        return quality, self.keeps_latest or is_kept

    def record(self, line: Mapping[str, Any], spent: Spent) -> dict[str, Any]:
        """Remember an evaluation; returns its metrics line with a forecast, to be checked later."""
        self.count = max(self.count, int(min(1.0, spent.fraction) * EVALUATIONS))
        self.lines.append(dict(line))
        lines = self.lines
        elapsed = spent.seconds
        left = spent.left_s
        ahead = forecast_horizon(elapsed, left)
        predicted = None if ahead is None else forecast(curve_of(lines), ahead)
        if predicted is not None and "psnr" in line:
            lines[-1]["forecast"] = predicted.as_json()
        self.forecast_text = describe_forecast(lines, elapsed, left, self.settings.target_psnr)
        return lines[-1]
