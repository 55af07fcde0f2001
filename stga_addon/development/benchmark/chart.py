"""Chart of a benchmark: accuracy against training time, one curve per variant."""

from collections.abc import Mapping

from PIL import Image

from ...report.charts import Line, chart
from .statistics import MeanCurve, leaders


def benchmark_chart(curves: Mapping[str, MeanCurve], title: str) -> Image.Image:
    """One curve a variant with the range of its seeds; the Pareto front is drawn bold."""
    spans = leaders(curves)
    lines = [
        Line(
            name,
            curve.seconds,
            curve.mean,
            (curve.low, curve.high),
            tuple((start, end) for leader, start, end in spans if leader == name),
        )
        for name, curve in curves.items()
    ]
    return chart(lines, title)
