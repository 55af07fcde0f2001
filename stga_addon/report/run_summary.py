"""How a run goes and what it came to, in a picture and a few lines, read from its metrics."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any

from ..errors import StgaError
from ..files import replacing
from ..training.evaluate.forecast import clock, curve_of, hits, level_since, missed
from ..training.run.folder import read_run
from ..training.run.metrics_log import METRICS, read_metrics
from .charts import run_chart

CURVE = "curve.png"
DRAWING_SHARE = 0.01
"""Largest share of the time that goes into drawing the curve again while a run trains."""


class CurveDrawer:
    """Keeps the curve in a run's folder up to date, with the last forecast; to be called now and then."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._drawn, self._wait_until = folder, -1, 0.0

    def __call__(self) -> None:
        now = perf_counter()
        if now < self._wait_until:
            return
        path = self._folder / METRICS
        size = path.stat().st_size if path.exists() else 0
        if size != self._drawn:
            with suppress(StgaError):  # training goes on without; where the disk is full, it will say so itself
                draw_curve(self._folder)
            self._drawn = size
        spent = perf_counter() - now
        self._wait_until = now + spent / DRAWING_SHARE


def draw_curve(folder: Path) -> None:
    """Replace the picture of the curve in a run's folder; nothing before the first evaluation."""
    metrics = read_metrics(folder)
    if curve_of(metrics):
        with replacing(folder / CURVE) as partial:
            run_chart(metrics).save(partial, format="PNG")


def conclude(folder: Path) -> list[str]:
    """The lines for a person whose run has ended; leaves the curve as a picture in the run's folder."""
    draw_curve(folder)
    return describe_run(read_metrics(folder), read_run(folder).settings.target_psnr)


def describe_run(metrics: Sequence[Mapping[str, Any]], target: float | None) -> list[str]:
    """Accuracy, where it was reached, the forecasts checked, and what evaluation and memory came to."""
    if not metrics:
        return []
    lines, curve, last = [], curve_of(metrics), metrics[-1]
    if curve:
        best = max((line for line in metrics if "psnr" in line), key=lambda line: line["psnr"])
        parts = [f"{best['psnr']:.2f} dB", f"SSIM {best['ssim']:.4f}"]
        named = (("psnr_mask", "in the head mask"), ("psnr_selected", "in what moves"))
        parts += [f"{best[key]:.2f} dB {name}" for key, name in named if key in best]
        lines.append(f"held-out views: {', '.join(parts)}, after {clock(best['seconds'])}, which the avatar shows")
    if target is not None and curve:
        reached = any(psnr >= target for _, psnr in curve)
        lines.append(f"{target:g} dB was reached" if reached else missed(curve, target))
    level = level_since(curve)
    if level is not None:
        lines.append(f"nothing was gained after {clock(level)}: more time does not help with these settings")
    hit, checked = hits(metrics)
    if checked:
        lines.append(f"forecasts: {hit} of {checked} came true within their error")
    memory = f", peak memory {last['peak_memory_mb']:,.0f} MB" if last.get("peak_memory_mb") else ""
    lines.append(f"evaluation took {evaluation_share(metrics):.1%} of the training time, on top of it{memory}")
    return lines


def evaluation_share(lines: Sequence[Mapping[str, Any]]) -> float:
    """Seconds of evaluation while training over seconds of training; the last evaluation comes after it."""
    spent: float = sum(line["evaluation_s"] for line in lines[:-1])
    return spent / max(float(lines[-1]["seconds"]), 1e-9)
