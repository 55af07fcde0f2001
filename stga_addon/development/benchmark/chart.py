"""Chart of a benchmark: PSNR over training time, one curve per variant."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from ...report.charts import finish_axes, psnr_axes
from .statistics import MeanCurve, pareto_front

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def benchmark_chart(curves: Mapping[str, MeanCurve], title: str) -> "Figure":
    """One curve per variant with the range over its seeds; the Pareto front is bold."""
    figure, axes = psnr_axes(title)
    front = pareto_front(curves)
    for name, curve in curves.items():
        (line,) = axes.plot(curve.seconds, curve.mean, label=name)
        color = line.get_color()
        axes.fill_between(curve.seconds, curve.low, curve.high, color=color, alpha=0.2, linewidth=0)
        for best, start, end in front:
            if best == name:
                shown = (curve.seconds >= start) & (curve.seconds <= end)
                axes.plot(curve.seconds[shown], curve.mean[shown], color=color, linewidth=4)
    finish_axes(axes)
    return figure
