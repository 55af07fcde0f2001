"""Benchmark of variants trained for the same wall time, as a plan of a batch, and its report, table
and chart."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import StgaError
from ...files import replacing, write_json
from ...format import format_duration
from ...jobs.batch.plan import Plan
from ...schema import to_json
from ...training.evaluate.forecast import FITTED_HEADS
from ...training.run.report import evaluation_fraction, finish_axes, psnr_axes
from .statistics import (
    MeanCurve,
    Outcome,
    Spread,
    count_forecasts,
    mean_curves,
    outcome_of,
    pareto_front,
    summarize,
    within_spread,
)
from .variants import STANDARD, Benchmark, variants_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SEEDS = 1000
"""Largest number of seeds of a variant."""
MEMORY_GB = 1.0
"""Memory of a variant's process. All variants of a slice run at the same time."""
COLUMNS = {
    "iterations": ("iterations", 0),
    "ms_per_iteration": ("ms/it", 1),
    "splats": ("splats", 0),
    "peak_memory_mb": ("MB", 0),
    "val_psnr": ("val", 2),
    "val_psnr_fitted_heads": ("val fitted heads", 2),
    "val_psnr_unmatched": ("val unfitted", 2),
    "val_psnr_mask": ("head", 2),
    "val_psnr_moving": ("moving", 2),
    "val_ssim": ("SSIM", 4),
    "val_lpips": ("LPIPS", 4),
    "test_psnr": ("test", 2),
    "test_psnr_fitted_heads": ("test fitted heads", 2),
    "test_psnr_unmatched": ("test unfitted", 2),
    "test_psnr_moving": ("moving", 2),
    "test_lpips": ("LPIPS", 4),
}
"""Figure -> heading and decimals. PSNR in dB on held-out views (val) and unseen expressions (test).
Unfitted: without fitted exposure. Fitted heads: of unseen timesteps, by the avatar; else as
tracked."""


def benchmark_jobs(name: str, request: Benchmark, seeds: int) -> dict[str, Any]:
    """Jobs of a plan that carry out a benchmark: a slice for each seed, called NAME-seed0 and so
    on.

    request: its folder counts for nothing, and its seed. Raises StgaError for unknown variants, and
    too many seeds.
    """
    if seeds > MAX_SEEDS:
        raise StgaError(f"--seeds {seeds}: expected up to {MAX_SEEDS}")
    count = len(variants_of(request))
    given = {
        key: value for key, value in to_json(request).items() if key not in ("out", "seed", "flame")
    }
    if request.flame is not None:
        given["flame"] = str(request.flame)
    needs = {"minutes": count * request.seconds / 60, "resources": {"memory_gb": MEMORY_GB * count}}
    return {
        f"{name}-seed{seed}": {"request": "benchmark", **given, "seed": seed, **needs}
        for seed in range(seeds)
    }


def slices_of(plan: Plan, name: str) -> list[Benchmark]:
    """The slices of a benchmark of the plan, by seed."""
    found = [
        job.request
        for job in plan.jobs
        if isinstance(job.request, Benchmark) and job.name.startswith(f"{name}-seed")
    ]
    return sorted(found, key=lambda request: request.seed)


def write_report(slices: Sequence[Benchmark], out: Path) -> str:
    """Write report.txt, benchmark.json, benchmark.csv and benchmark.png of what is finished so far
    into a folder; returns the report."""
    first = slices[0]
    names = list(variants_of(slices[0]))
    found = [outcome_of(name, one.seed, one.out / name) for name in names for one in slices]
    outcomes = [outcome for outcome in found if outcome is not None]
    curves = mean_curves(outcomes)
    report = report_text(outcomes, curves, first.seconds, first.capture)
    with replacing(out / "report.txt") as partial:
        partial.write_text(report + "\n", encoding="utf-8")
    write_json(out / "benchmark.json", _as_json(outcomes, first.seconds))
    _write_csv(out / "benchmark.csv", outcomes)
    if curves:
        fitted = any(
            "psnr_unmatched" in figures for one in outcomes for figures in one.quality.values()
        )
        views = "held-out views, exposure not fitted" if fitted else "held-out views"
        title = f"{first.capture.name}: PSNR on {views}, {len(slices)} seeds; bold: Pareto front"
        with replacing(out / "benchmark.png") as partial:
            benchmark_chart(curves, title).savefig(partial, format="png")
    return report


def report_text(
    outcomes: Sequence[Outcome], curves: Mapping[str, MeanCurve], seconds: float, capture: Path
) -> str:
    """Table and conclusions, as Markdown."""
    table = summarize(outcomes)
    runs = [outcome for outcome in outcomes if outcome.quality]
    if not table:
        return f"{capture.name}: no run is finished yet"
    counts = sorted({spreads["iterations"].count for spreads in table.values()})
    seeds = f"{'–'.join(map(str, counts))} seed{'' if counts == [1] else 's'}"
    lines = [
        f"{capture.name}, {format_duration(seconds)} of training each, {seeds}; mean ± spread",
        "",
        *table_lines(table),
        "",
        *_comparisons(table),
    ]
    spans = [
        f"{name} {format_duration(start)}–{format_duration(end)}"
        for name, start, end in pareto_front(curves)
    ]
    hit, checked = count_forecasts(runs)
    if any("val_psnr_unmatched" in row for row in table.values()):
        lines.append(
            "The exposure of held-out cameras is fitted for all variants, "
            "but not in columns called unfitted."
        )
    if any(name.endswith(FITTED_HEADS) for row in table.values() for name in row):
        lines.append(
            "Heads are as tracked; in columns called fitted heads, the avatar has fitted those of "
            "unseen timesteps to the images that it is measured by."
        )
    lines += [f"Pareto front of PSNR over time: {', '.join(spans)}."] if spans else []
    lines += (
        [f"Forecasts correct within their error: {hit} of {checked} ({hit / checked:.0%})."]
        if checked
        else []
    )
    fraction = float(np.mean([evaluation_fraction(outcome.lines) for outcome in runs]))
    lines.append(
        f"Evaluation while training took {fraction:.1%} of the training time, which excludes it."
    )
    return "\n".join(lines)


def table_lines(table: Mapping[str, Mapping[str, Spread]]) -> list[str]:
    """Lines of an aligned Markdown table."""
    columns = [name for name in COLUMNS if any(name in row for row in table.values())]
    reference = table.get(STANDARD, {}).get("val_psnr")
    rows = [["variant", *(COLUMNS[name][0] for name in columns)]]
    if reference is not None:
        rows[0].append("Δ val")
    for variant, row in table.items():
        cells = [variant, *(_cell(row.get(name), COLUMNS[name][1]) for name in columns)]
        if reference is not None:
            cells.append(
                f"{row['val_psnr'].mean - reference.mean:+.2f}" if "val_psnr" in row else ""
            )
        rows.append(cells)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    rows.insert(1, ["-" * width for width in widths])
    return [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]


def _cell(value: Spread | None, decimals: int) -> str:
    if value is None:
        return ""
    spread = "" if decimals < 2 or np.isnan(value.spread) else f"±{value.spread:.{decimals}f}"
    return f"{value.mean:,.{decimals}f}{spread}"


def _comparisons(table: Mapping[str, Mapping[str, Spread]]) -> list[str]:
    """Neighbors in the ranking by held-out PSNR that differ by no more than their spread."""
    ranked = sorted(
        ((row["val_psnr"], name) for name, row in table.items() if "val_psnr" in row),
        key=lambda pair: -pair[0].mean,
    )
    if any(value.count < 2 for value, _ in ranked):
        return ["One seed gives no spread: differences below about 0.3 dB are not significant."]
    lines = [
        f"{first} and {second} are {a.mean - b.mean:.2f} dB apart, which is within their spread."
        for (a, first), (b, second) in pairwise(ranked)
        if within_spread(a, b)
    ]
    return lines or ["All neighbors in the ranking differ by more than their spread."]


def _as_json(outcomes: Iterable[Outcome], seconds: float) -> dict[str, object]:
    runs = [
        {
            "variant": outcome.variant,
            "seed": outcome.seed,
            "finished": bool(outcome.quality),
            "figures": outcome.figures(),
            "curve": outcome.lines,
        }
        for outcome in outcomes
    ]
    return {"seconds": seconds, "runs": runs}


def _write_csv(path: Path, outcomes: Sequence[Outcome]) -> None:
    """One row per evaluation, with all values of its metrics line."""
    rows = [
        {
            "variant": outcome.variant,
            "seed": outcome.seed,
            **{k: v for k, v in line.items() if k != "forecast"},
        }
        for outcome in outcomes
        for line in outcome.lines
    ]
    names = list(dict.fromkeys(name for row in rows for name in row))
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        writer.writerows(rows)


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
                within = (curve.seconds >= start) & (curve.seconds <= end)
                axes.plot(curve.seconds[within], curve.mean[within], color=color, linewidth=4)
    finish_axes(axes)
    return figure
