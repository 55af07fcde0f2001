"""Statistics of benchmark runs: means and spreads over seeds, mean curves and the Pareto front."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...files import read_json
from ...training.evaluate.forecast import UNMATCHED, checked_forecasts, curve_of
from ...training.run.metrics_log import read_metrics
from .worker import QUALITY

CURVE_POINTS = 200
"""Points of a mean curve."""


@dataclass(frozen=True)
class Outcome:
    """One finished or interrupted run.

    lines    its metrics.jsonl
    quality  split -> the best avatar's figures on all of its views; empty for an interrupted run
    """

    variant: str
    seed: int
    lines: list[dict[str, Any]]
    quality: Mapping[str, Mapping[str, float]]

    def figures(self) -> dict[str, float]:
        """Column of the table -> value, for what was measured."""
        last = self.lines[-1]
        figures = {
            "iterations": last["iteration"],
            "ms_per_iteration": 1000 * last["seconds"] / max(last["iteration"], 1),
            "splats": last["splats"],
        }
        if last.get("peak_memory_mb"):
            figures["peak_memory_mb"] = last["peak_memory_mb"]
        for split, values in self.quality.items():
            figures.update({f"{split}_{name}": value for name, value in values.items()})
        return figures


@dataclass(frozen=True)
class Spread:
    """Mean over seeds and sample standard deviation, which is NaN for one seed."""

    mean: float
    spread: float
    count: int


@dataclass(frozen=True)
class MeanCurve:
    """Held-out PSNR without fitted exposure, so that variants compare, over seconds of training.

    Mean over seeds, and the lowest and highest of them, (M,) each."""

    seconds: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def outcome_of(variant: str, seed: int, run: Path) -> Outcome | None:
    """The outcome so far of the run in a folder; None before its first evaluation."""
    lines = read_metrics(run)
    quality = read_json(run / QUALITY) if (run / QUALITY).exists() else {}
    return Outcome(variant, seed, lines, quality) if lines else None


def summarize(outcomes: Sequence[Outcome]) -> dict[str, dict[str, Spread]]:
    """variant -> column -> mean and spread, over its finished runs."""
    table: dict[str, dict[str, Spread]] = {}
    for variant in dict.fromkeys(outcome.variant for outcome in outcomes):
        rows = [
            outcome.figures()
            for outcome in outcomes
            if outcome.variant == variant and outcome.quality
        ]
        columns = [name for name in (rows[0] if rows else {}) if all(name in row for row in rows)]
        if rows:
            table[variant] = {name: spread_of([row[name] for row in rows]) for name in columns}
    return table


def spread_of(values: Sequence[float]) -> Spread:
    several = len(values) > 1
    return Spread(
        float(np.mean(values)),
        float(np.std(values, ddof=1)) if several else float("nan"),
        len(values),
    )


def within_spread(a: Spread, b: Spread) -> bool:
    """Whether two means differ by no more than the sum of their spreads."""
    return abs(a.mean - b.mean) <= a.spread + b.spread


def mean_curves(outcomes: Sequence[Outcome]) -> dict[str, MeanCurve]:
    """variant -> its curve over the time that all of its runs cover."""
    curves = {}
    for variant in dict.fromkeys(outcome.variant for outcome in outcomes):
        runs = [
            _unfitted_curve(outcome.lines) for outcome in outcomes if outcome.variant == variant
        ]
        runs = [run for run in runs if len(run) > 1]
        if not runs:
            continue
        seconds = np.linspace(
            max(run[0][0] for run in runs), min(run[-1][0] for run in runs), CURVE_POINTS
        )
        values = np.array([np.interp(seconds, *np.array(run).T) for run in runs])
        curves[variant] = MeanCurve(seconds, values.mean(0), values.min(0), values.max(0))
    return curves


def _unfitted_curve(lines: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """`curve_of` PSNR without fitted exposure."""
    return curve_of(
        [
            {**line, "psnr": line.get(UNMATCHED, line["psnr"])} if "psnr" in line else line
            for line in lines
        ]
    )


def pareto_front(curves: Mapping[str, MeanCurve]) -> list[tuple[str, float, float]]:
    """(variant, from, to) in seconds: the variant with the highest PSNR, while that exceeds every
    earlier PSNR."""
    if not curves:
        return []
    seconds = np.linspace(
        min(c.seconds[0] for c in curves.values()), max(c.seconds[-1] for c in curves.values()), 400
    )
    heights = np.array(
        [
            np.interp(seconds, c.seconds, c.mean, left=-np.inf, right=-np.inf)
            for c in curves.values()
        ]
    )
    best = heights.argmax(0)
    names = list(curves)
    spans: list[tuple[str, float, float]] = []
    for second, winner, is_higher in zip(
        seconds.tolist(), best.tolist(), _exceeds_earlier(heights.max(0)), strict=True
    ):
        if not is_higher:
            continue
        if spans and spans[-1][0] == names[winner]:
            spans[-1] = (names[winner], spans[-1][1], second)
        else:
            spans.append((names[winner], second, second))
    return spans


def count_forecasts(outcomes: Sequence[Outcome]) -> tuple[int, int]:
    """Forecasts of all runs that were correct within their error, and those that could be
    checked."""
    pairs = [checked_forecasts(outcome.lines) for outcome in outcomes]
    return sum(hit for hit, _ in pairs), sum(count for _, count in pairs)


def _exceeds_earlier(values: np.ndarray) -> list[bool]:
    before = np.concatenate([[-np.inf], np.maximum.accumulate(values)[:-1]])
    return [bool(higher) for higher in values > before]
