"""Charts of PSNR over training time, drawn by matplotlib."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..training.evaluate.forecast import DETAIL, UNMATCHED, curve_of, is_exposure_fitted

if TYPE_CHECKING:  # imported when a chart is drawn: it takes half a second, and the command line starts without it
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#785e3c", "#5a5a5a")
"""Okabe and Ito's palette, which people with any color vision can tell apart."""


def run_chart(metrics: Sequence[Mapping[str, Any]]) -> "Figure":
    """PSNR of one run in the whole image, the head mask and the moving region, with the latest forecast; and the detail
    difference, by which the avatar is kept, on an axis of its own with the best at the top."""
    fitted = " (exposure fitted)" if is_exposure_fitted(metrics) else ""
    figure, axes = psnr_axes(f"PSNR{fitted} and detail difference on held-out views")
    keys = {"whole image": "psnr", "head mask": "psnr_mask", "moving region": "psnr_moving"}
    for name, key in {**keys, "whole image, exposure not fitted": UNMATCHED}.items():
        curve = curve_of(metrics, key)
        if curve:
            axes.plot(*np.array(curve).T, marker=".", label=name)
    if metrics and "forecast" in metrics[-1]:
        last, ahead = metrics[-1], metrics[-1]["forecast"]
        seconds, psnr = [last["seconds"], ahead["seconds"]], np.array([last["psnr"], ahead["psnr"]])
        error = np.array([0, ahead["error"]])
        (line,) = axes.plot(seconds, psnr, linestyle="--", label="forecast")
        axes.fill_between(seconds, psnr - error, psnr + error, color=line.get_color(), alpha=0.2, linewidth=0)
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
    figure.subplots_adjust(left=0.08, right=0.98, bottom=0.1, top=0.93)  # `constrained` takes as long as the drawing
    axes = figure.subplots()
    axes.set(title=title, xlabel="training time [s]", ylabel="PSNR [dB]")
    axes.set_prop_cycle(color=COLORS)
    axes.grid(alpha=0.3)
    return figure, axes


def finish_axes(axes: "Axes") -> None:
    """Add the legend and cut off the steep start: the axis begins at the lowest value after a tenth of the time."""
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
