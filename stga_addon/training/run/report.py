"""What is shown of a run: its summary, and its curve by matplotlib and, for Blender, by numpy."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import StgaError
from ...files import replacing
from ...format import describe_gain, format_duration
from ..evaluate import forecast as forecasts
from ..evaluate.forecast import (
    DETAIL,
    FITTED_HEADS,
    UNMATCHED,
    curve_of,
    detail_curve,
)
from ..settings import TrainingSettings
from .folder import read_run
from .metrics_log import REGION_PSNR, TRACKING_GAIN, read_metrics

# imported when a chart is drawn: it takes half a second, and the command line starts without it
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVE = "curve.png"
"""Picture in a run's folder: held-out PSNR over training time."""
MAX_DRAWING_FRACTION = 0.01
"""Largest fraction of the time that drawing the curve may take while a run trains."""

FIRST_DRAWING_S = 30.0  # Time before the first drawing: loading the library takes a few seconds


class CurveUpdater:
    """Keeps the curve in a run's folder up to date; call it as often as convenient."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._drawn_count = 0
        self._next_update = perf_counter() + FIRST_DRAWING_S

    def __call__(self, metrics: Sequence[Mapping[str, Any]]) -> None:
        now = perf_counter()
        if now < self._next_update:
            return
        if len(metrics) != self._drawn_count:
            with suppress(StgaError):  # a curve that cannot be written must not end the training
                write_curve(self._folder, metrics)
            self._drawn_count = len(metrics)
        spent = perf_counter() - now
        self._next_update = now + spent / MAX_DRAWING_FRACTION


def write_curve(folder: Path, metrics: Sequence[Mapping[str, Any]]) -> None:
    """Write curve.png of the run in `folder`, with an evaluation to draw and matplotlib."""
    if curve_of(metrics) and find_spec("matplotlib") is not None:
        with replacing(folder / CURVE) as partial:
            run_chart(metrics).savefig(partial, format="png")


def report_run(folder: Path, metrics: Sequence[Mapping[str, Any]] = ()) -> list[str]:
    """Write the curve of a finished run and return the lines of its summary.

    metrics: its evaluations, where they were read already.
    """
    run = read_run(folder)
    metrics = metrics or read_metrics(folder)
    write_curve(folder, metrics)
    lines = summarize_run(metrics, run.settings)
    if run.continuation is not None:
        lines = summarize_continuation(metrics)
    if (folder / CURVE).exists():
        return lines
    reason = "no held-out views (split 'val') were evaluated"
    if curve_of(metrics):
        reason = "matplotlib is not installed"
    return [*lines, f"{CURVE} was not drawn: {reason}"]


def summarize_run(metrics: Sequence[Mapping[str, Any]], settings: TrainingSettings) -> list[str]:
    """Lines on accuracy, target, checked forecasts, and cost of evaluation and memory."""
    if not metrics:
        return []
    lines = []
    curve = curve_of(metrics)
    last = metrics[-1]
    target = settings.target_psnr
    if curve:
        evaluations = [line for line in metrics if "psnr" in line]
        best = forecasts.kept_line(evaluations, settings)
        fitted = ""
        if UNMATCHED in best:
            fitted = f" (exposure fitted; {best[UNMATCHED]:.2f} dB without)"
        parts = [f"{best['psnr']:.2f} dB{fitted}", f"SSIM {best['ssim']:.4f}"]
        named = (("psnr_mask", "in the head mask"), ("psnr_moving", "in the moving region"))
        parts += [f"{best[key]:.2f} dB {name}" for key, name in named if key in best]
        parts += [f"detail difference {best[DETAIL]:.4f}"] if DETAIL in best else []
        when = format_duration(best["seconds"])
        fitted_psnr = last.get(f"psnr{FITTED_HEADS}")
        heads = "" if fitted_psnr is None else ", heads as tracked"
        lines.append(f"held-out views{heads}: {', '.join(parts)}, after {when} (the saved avatar)")
        if fitted_psnr is not None:
            ssim = f"SSIM {last[f'ssim{FITTED_HEADS}']:.4f}"
            heads = "heads of unseen timesteps fitted to them by the avatar"
            lines.append(f"held-out views, {heads}: {fitted_psnr:.2f} dB, {ssim}")
    if target is not None and curve:
        text = f"{target:g} dB was reached"
        if all(psnr < target for _, psnr in curve):
            text = forecasts.explain_missed_target(curve, target)
        lines.append(f"{text} (exposure fitted)" if forecasts.is_exposure_fitted(metrics) else text)
    gain = next((line[TRACKING_GAIN] for line in metrics if TRACKING_GAIN in line), None)
    if gain is not None:
        verb, then = ("gain", "") if gain > 0 else ("lose", ", so heads stay as they were tracked")
        outcome = f"views left out {verb} {abs(gain):.2f} dB{then}"
        if math.isnan(gain):
            outcome = "kept unchecked: no view could be left out of it"
        lines.append(f"tracking by the avatar: {outcome}")
    plateau = forecasts.flat_since(metrics)
    if plateau is not None:
        helps = "more time does not help with these settings"
        lines.append(f"nothing was gained after {format_duration(plateau)}: {helps}")
    held, checked = forecasts.checked_forecasts(metrics)
    if checked:
        lines.append(f"forecasts: {held} of {checked} held within their error")
    memory = f", peak memory {last['peak_memory_mb']:,.0f} MB" if last.get("peak_memory_mb") else ""
    fraction = f"{evaluation_fraction(metrics):.1%} of the training time"
    return [*lines, f"evaluation took {fraction}, in addition to it{memory}"]


def summarize_continuation(metrics: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines on the accuracy before and after, by region and group of held-out views."""
    if not metrics:
        return []
    first = metrics[0]
    last = metrics[-1]
    lines = [f"splats: {first['splats']} before, {last['splats']} after"]
    fitted = " (exposure fitted)" if UNMATCHED in first else ""
    all_views = {"psnr": f"held-out views{fitted}"}
    all_views[UNMATCHED] = "held-out views (exposure not fitted)"
    parts = [name for name in first if name.startswith("psnr_") and name != UNMATCHED]
    for name in (*(name for name in all_views if name in first), *parts):
        label = all_views.get(name, name.removeprefix("psnr_").replace("_", " ") + fitted)
        before = first[name]
        after = last.get(name, math.nan)
        change = f"{before:.2f} dB before, {after:.2f} dB after ({after - before:+.2f})"
        if name == REGION_PSNR:
            change = describe_gain(before, after)
        lines.append(f"{label}: {change}")
    return lines


def evaluation_fraction(lines: Sequence[Mapping[str, Any]]) -> float:
    """Seconds of evaluation during training, the final one left out, over those of training."""
    spent: float = sum(line["evaluation_s"] for line in lines[:-1])
    return spent / max(float(lines[-1]["seconds"]), 1e-9)


# Charts by matplotlib

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#785e3c", "#5a5a5a")
"""Okabe and Ito's palette, which people with any color vision can tell apart."""


def run_chart(metrics: Sequence[Mapping[str, Any]]) -> "Figure":
    """PSNR in image, head mask and moving region, the latest forecast, and detail upside down."""
    fitted = " (exposure fitted)" if forecasts.is_exposure_fitted(metrics) else ""
    figure, axes = psnr_axes(f"PSNR{fitted} and detail difference on held-out views")
    keys = {"whole image": "psnr", "head mask": "psnr_mask", "moving region": "psnr_moving"}
    for name, key in {**keys, "whole image, exposure not fitted": UNMATCHED}.items():
        curve = curve_of(metrics, key)
        if curve:
            axes.plot(*np.array(curve).T, marker=".", label=name)
    if metrics and "forecast" in metrics[-1]:
        last = metrics[-1]
        ahead = metrics[-1]["forecast"]
        seconds = [last["seconds"], ahead["seconds"]]
        psnr = np.array([last["psnr"], ahead["psnr"]])
        error = np.array([0, ahead["error"]])
        (line,) = axes.plot(seconds, psnr, linestyle="--", label="forecast")
        axes.fill_between(
            seconds, psnr - error, psnr + error, color=line.get_color(), alpha=0.2, linewidth=0
        )
    detail = np.array(curve_of(metrics, DETAIL)).reshape(-1, 2).T
    if detail.size:
        figure.subplots_adjust(right=0.9)
        right = axes.twinx()
        right.set(ylabel="detail difference (lower is better)", yscale="log")
        right.yaxis.set_major_formatter("{x:g}")
        right.yaxis.set_minor_formatter("{x:g}")
        right.plot(*detail, color=COLORS[-1], linestyle=":", marker=".")
        right.invert_yaxis()
        axes.plot([], [], color=COLORS[-1], linestyle=":", marker=".", label="detail difference")
    finish_axes(axes)
    return figure


def psnr_axes(title: str) -> tuple["Figure", "Axes"]:
    """An empty chart of 900 × 540 pixels; `Figure.savefig` renders it without a display."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5.4), dpi=100)
    # `constrained` takes as long as the drawing
    figure.subplots_adjust(left=0.08, right=0.98, bottom=0.1, top=0.93)
    axes = figure.subplots()
    axes.set(title=title, xlabel="training time [s]", ylabel="PSNR [dB]")
    axes.set_prop_cycle(color=COLORS)
    axes.grid(alpha=0.3)
    return figure, axes


def finish_axes(axes: "Axes") -> None:
    """Add the legend and cut off the steep start, at the lowest value after a tenth of the time."""
    curves = [np.asarray(line.get_xydata()).T for line in axes.lines]
    curves = [curve for curve in curves if curve.size]
    if not curves:
        return
    tenth = max(x[-1] for x, _ in curves) / 10
    lowest = min(min([float(np.interp(tenth, x, y)), *y[x >= tenth].tolist()]) for x, y in curves)
    highest = max(float(y.max()) for _, y in curves)
    axes.set_ylim(bottom=lowest - 0.05 * (highest - lowest) - 1e-3)
    axes.set_xlim(left=0)
    axes.legend(loc="lower right")


# The curve in Blender's panel: its Python need not have matplotlib or Pillow

SIZE = 256
"""Width and height in pixels: Blender's icons are square."""
MARGIN = 6.0
"""Empty border of the picture, in pixels."""
LINE_WIDTH = 3.0
"""Width of the curves, in pixels."""
BACKGROUND_COLOR = (0.11, 0.11, 0.11)
"""Color of the picture where nothing is drawn; RGB in 0…1, as the four below."""
GRID_COLOR = (0.25, 0.25, 0.25)
"""Color of the lines at equal PSNR."""
CURVE_COLOR = (0.34, 0.71, 0.91)
"""Color of the held-out PSNR: sky blue of the Okabe–Ito palette, whose colors color-blind people
tell apart."""
FORECAST_COLOR = (0.90, 0.62, 0.0)
"""Color of the forecast and its band: orange of that palette."""
DETAIL_COLOR = (0.0, 0.62, 0.45)
"""Color of the detail difference: bluish green of that palette."""
BAND_OPACITY = 0.35
"""Opacity of the band that shows a forecast's error."""
GRID_STEPS_DB = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""The first step is used that gives at most MAX_GRID_STEPS."""
MAX_GRID_STEPS = 6

Color = tuple[float, float, float]


def curve_image(lines: Sequence[Mapping[str, Any]]) -> tuple[np.ndarray, str, str] | None:
    """Held-out PSNR over training time, with the last forecast and its error; None before two
    evaluations.

    The detail difference, by which the avatar is kept, is drawn in green over the whole height, the
    best at the top.
    lines: of a metrics.jsonl. Returns (SIZE, SIZE, 4) float32 RGBA in 0…1, the bottom row first,
    and as texts the ranges of the axes and of the detail difference (empty if it was not measured).
    The steep beginning is cut off: the vertical axis starts at the PSNR of a tenth of the time.
    """
    curve = curve_of(lines)
    if len(curve) < 2:
        return None
    seconds, psnr = np.array(curve, np.float64).T
    forecast = lines[-1].get("forecast")
    end = seconds[-1]
    high = psnr.max()
    if forecast is not None:
        end = forecast["seconds"]
        high = max(high, forecast["psnr"] + forecast["error"])
    low = min(float(np.interp(end / 10, seconds, psnr)), psnr[-1])
    step = next(
        (step for step in GRID_STEPS_DB if (high - low) / step <= MAX_GRID_STEPS), GRID_STEPS_DB[-1]
    )
    low = step * np.floor(low / step)
    high = step * np.ceil(high / step + 1e-9)
    plot = _Plot((0.0, end), (low, high))
    plot.grid(np.arange(low, high + step / 2, step))
    if forecast is not None:
        x = np.array([seconds[-1], end])
        y = np.array([psnr[-1], forecast["psnr"]])
        error = np.array([0.0, forecast["error"]])
        plot.band(x, y - error, y + error, FORECAST_COLOR)
        plot.line(x, y, FORECAST_COLOR)
    when, detail = np.array(detail_curve(lines), np.float64).reshape(-1, 2).T
    detail_range = ""
    if len(detail) > 1:
        lowest = min(float(np.interp(when[-1] / 10, when, detail)), float(detail[-1]))
        fraction = (detail - lowest) / max(float(detail.max()) - lowest, 1e-9)
        plot.line(when, low + fraction * (high - low), DETAIL_COLOR)
        worst = 10 ** (-lowest / 20)
        best = min(value for _, value in curve_of(lines, DETAIL))
        detail_range = f"Detail difference {worst:.3f} to {best:.3f} (green)"
    plot.line(seconds, psnr, CURVE_COLOR)
    unmatched = lines[-1].get(UNMATCHED)
    fitted = "" if unmatched is None else f" (exposure fitted; {unmatched:.1f} without)"
    return plot.pixels, f"{low:g} to {high:g} dB{fitted}, 0 to {format_duration(end)}", detail_range


class _Plot:
    """An image with axes: x and y are the ranges of seconds and dB inside its margins."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self.pixels = np.ones((SIZE, SIZE, 4), np.float32)
        self.pixels[..., :3] = BACKGROUND_COLOR
        self._x = x
        self._y = y

    def grid(self, y: np.ndarray) -> None:
        self.pixels[self._rows(y).astype(int), :, :3] = GRID_COLOR

    def line(self, x: np.ndarray, y: np.ndarray, color: Color) -> None:
        """Antialiased by the distance of pixels' centers to the segment in their column."""
        seconds, inside = self._columns(x)
        height = np.interp(seconds, x, self._rows(y))
        slope = np.gradient(height)
        rows = np.arange(SIZE)[:, None] + 0.5
        distance = np.abs(rows - height) / np.sqrt(1 + slope**2)
        self._blend(np.clip(LINE_WIDTH / 2 + 0.5 - distance, 0, 1) * inside, color)

    def band(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, color: Color) -> None:
        seconds, inside = self._columns(x)
        rows = np.arange(SIZE)[:, None] + 0.5
        bottom, top = (np.interp(seconds, x, self._rows(edge)) for edge in (low, high))
        self._blend(BAND_OPACITY * ((rows >= bottom) & (rows <= top) & inside), color)

    def _columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Seconds at each column's center, and whether they are in the range of x."""
        columns = np.arange(SIZE) + 0.5
        seconds = self._x[0] + (columns - MARGIN) / (SIZE - 2 * MARGIN) * (self._x[1] - self._x[0])
        return seconds, (seconds >= x[0]) & (seconds <= x[-1])

    def _rows(self, y: np.ndarray) -> np.ndarray:
        return MARGIN + (y - self._y[0]) / (self._y[1] - self._y[0]) * (SIZE - 2 * MARGIN)

    def _blend(self, opacity: np.ndarray, color: Color) -> None:
        self.pixels[..., :3] += opacity[..., None] * (
            np.array(color, np.float32) - self.pixels[..., :3]
        )
