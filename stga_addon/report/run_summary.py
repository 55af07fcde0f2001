"""Summary of a training run and its curve as a picture, from its metrics."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

from ..errors import StgaError
from ..files import replacing
from ..format import format_duration
from ..training.evaluate.forecast import (
    DETAIL,
    UNMATCHED,
    checked_forecasts,
    curve_of,
    explain_missed_target,
    flat_since,
    is_exposure_fitted,
    saved_line,
)
from ..training.run.folder import read_run
from ..training.run.metrics_log import METRICS, read_metrics
from .charts import run_chart

CURVE = "curve.png"
MAX_DRAWING_SHARE = 0.01
"""Largest share of the time that drawing the curve may take while a run trains."""

FIRST_DRAWING_S = 30.0
"""Seconds until the first: loading the library takes a few, while the user waits for the first preview."""


class CurveUpdater:
    """Keeps the curve in a run's folder up to date; call it as often as convenient."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._drawn_size = folder, -1
        self._next_update = perf_counter() + FIRST_DRAWING_S

    def __call__(self) -> None:
        now = perf_counter()
        if now < self._next_update:
            return
        path = self._folder / METRICS
        size = path.stat().st_size if path.exists() else 0
        if size != self._drawn_size:
            with suppress(StgaError):  # a curve that cannot be written must not end the training
                write_curve(self._folder)
            self._drawn_size = size
        spent = perf_counter() - now
        self._next_update = now + spent / MAX_DRAWING_SHARE


def write_curve(folder: Path) -> None:
    """Write curve.png of the run in `folder`, if there is an evaluation to draw and matplotlib to draw it."""
    metrics = read_metrics(folder)
    if curve_of(metrics) and find_spec("matplotlib") is not None:
        with replacing(folder / CURVE) as partial:
            run_chart(metrics).savefig(partial, format="png")


def report_run(folder: Path) -> list[str]:
    """Write the curve of a finished run and return the lines of its summary."""
    write_curve(folder)
    run, metrics = read_run(folder), read_metrics(folder)
    continued = run.continuation is not None
    lines = summarize_continuation(metrics) if continued else summarize_run(metrics, run.settings.target_psnr)
    if (folder / CURVE).exists():
        return lines
    reason = "matplotlib is not installed" if curve_of(metrics) else "no held-out views (split 'val') were evaluated"
    return [*lines, f"{CURVE} was not drawn: {reason}"]


def summarize_run(metrics: Sequence[Mapping[str, Any]], target: float | None) -> list[str]:
    """Lines on accuracy, the target (dB), checked forecasts, and the cost of evaluation and memory."""
    if not metrics:
        return []
    lines, curve, last = [], curve_of(metrics), metrics[-1]
    if curve:
        evaluations = [line for line in metrics if "psnr" in line]
        best = saved_line(evaluations, target)
        fitted = f" (exposure fitted; {best[UNMATCHED]:.2f} dB without)" if UNMATCHED in best else ""
        parts = [f"{best['psnr']:.2f} dB{fitted}", f"SSIM {best['ssim']:.4f}"]
        named = (("psnr_mask", "in the head mask"), ("psnr_moving", "in the moving region"))
        parts += [f"{best[key]:.2f} dB {name}" for key, name in named if key in best]
        parts += [f"detail difference {best[DETAIL]:.4f}"] if DETAIL in best else []
        when = format_duration(best["seconds"])
        lines.append(f"held-out views: {', '.join(parts)}, after {when} (the saved avatar)")
    if target is not None and curve:
        reached = any(psnr >= target for _, psnr in curve)
        text = f"{target:g} dB was reached" if reached else explain_missed_target(curve, target)
        lines.append(f"{text} (exposure fitted)" if is_exposure_fitted(metrics) else text)
    plateau = flat_since(metrics)
    if plateau is not None:
        since = format_duration(plateau)
        lines.append(f"nothing was gained after {since}: more time does not help with these settings")
    held, checked = checked_forecasts(metrics)
    if checked:
        lines.append(f"forecasts: {held} of {checked} held within their error")
    memory = f", peak memory {last['peak_memory_mb']:,.0f} MB" if last.get("peak_memory_mb") else ""
    lines.append(f"evaluation took {evaluation_share(metrics):.1%} of the training time, in addition to it{memory}")
    return lines


def summarize_continuation(metrics: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines on the accuracy of the avatar before and after, by region and group of held-out views."""
    if not metrics:
        return []
    first, last = metrics[0], metrics[-1]
    lines = [f"splats: {first['splats']} before, {last['splats']} after"]
    for name, label in _labels(first).items():
        before, after = first[name], last.get(name, math.nan)
        lines.append(f"{label}: {before:.2f} dB before, {after:.2f} dB after ({after - before:+.2f})")
    return lines


def _labels(line: Mapping[str, Any]) -> dict[str, str]:
    """Each PSNR of a metrics line -> what it is called: of all held-out views, then by region and group."""
    fitted = " (exposure fitted)" if UNMATCHED in line else ""
    labels = {name: f"held-out views{fitted}" for name in ("psnr",) if name in line}
    if UNMATCHED in line:
        labels[UNMATCHED] = "held-out views (exposure not fitted)"
    parts = [name.removeprefix("psnr_") for name in line if name.startswith("psnr_") and name != UNMATCHED]
    return {**labels, **{f"psnr_{part}": part.replace("_", " ") + fitted for part in parts}}


def evaluation_share(lines: Sequence[Mapping[str, Any]]) -> float:
    """Seconds of evaluation during training over seconds of training; the final evaluation does not count."""
    spent: float = sum(line["evaluation_s"] for line in lines[:-1])
    return spent / max(float(lines[-1]["seconds"]), 1e-9)
