"""Benchmark of variants trained for the same wall time, and its report, table and chart."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ...files import replacing, write_json
from ...format import format_duration
from ...perform.training import prepare
from ...progress import ignore
from ...report.run_summary import evaluation_share
from ...requests.values import Train
from .chart import benchmark_chart
from .scheduler import BenchmarkRun, PrintProgress, train_in_turns
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
from .variants import STANDARD, Changes, settings_of, without_choices

COLUMNS = {
    "iterations": ("iterations", 0),
    "ms_per_iteration": ("ms/it", 1),
    "splats": ("splats", 0),
    "peak_memory_mb": ("MB", 0),
    "val_psnr": ("val", 2),
    "val_psnr_unmatched": ("val unfitted", 2),
    "val_psnr_mask": ("head", 2),
    "val_psnr_moving": ("moving", 2),
    "val_ssim": ("SSIM", 4),
    "val_lpips": ("LPIPS", 4),
    "test_psnr": ("test", 2),
    "test_psnr_unmatched": ("test unfitted", 2),
    "test_psnr_moving": ("moving", 2),
    "test_lpips": ("LPIPS", 4),
}
"""Figure -> heading and decimals. PSNR in dB on held-out views (val) and unseen expressions (test).
Unfitted: without fitted exposure."""


def run_benchmark(
    request: Train,
    variants: Mapping[str, Changes],
    seconds: float,
    seeds: int,
    print_progress: PrintProgress = print,
) -> str:
    """Train every variant for `seconds` with each seed; returns the report, which is also written.

    request: the capture to train, and as `run` the folder of the runs; its settings are ignored. Writes report.txt,
    benchmark.json, benchmark.csv and benchmark.png beside the runs, also when interrupted; the same call then
    continues. Raises StgaError where the folder holds a benchmark of other settings.
    """
    print_progress("Deciding effects")
    out, requests = request.run, _requests(request, variants, seconds)
    fits = any(each.settings.exposure for each in requests.values())  # for all variants or none, so that they compare
    by_seed = {
        seed: {name: BenchmarkRun(_seeded(each, seed), fits) for name, each in requests.items()}
        for seed in range(seeds)
    }
    for of_seed in by_seed.values():
        for one in of_seed.values():
            one.check()
    left = sum(not one.finished for of_seed in by_seed.values() for one in of_seed.values())
    if left:
        each, total = format_duration(seconds), format_duration(left * seconds)
        print_progress(f"{left} runs of {each}: {total} of training, plus the time to start and to evaluate")
    try:
        for seed, of_seed in by_seed.items():
            if not all(one.finished for one in of_seed.values()):
                train_in_turns(list(of_seed.values()), lambda text, seed=seed: print_progress(f"seed {seed}: {text}"))  # type: ignore[misc]
    except KeyboardInterrupt:
        print_progress(f"Finished runs are reported in {out / 'report.txt'}; run the same command to continue")
        raise
    finally:
        report = _write_report(request.capture, by_seed, seconds, out)
    return report


def _requests(request: Train, variants: Mapping[str, Changes], seconds: float) -> dict[str, Train]:
    """variant -> its training, with the effects that are decided for all seeds; a variant with the settings of an
    earlier one is left out."""
    requests: dict[str, Train] = {}
    for name, changes in variants.items():
        undecided = replace(request, run=request.run / name, settings=settings_of(changes, seconds))
        settings = without_choices(prepare(undecided, ignore, lambda line: None).run.settings)
        if not any(replace(settings, preset=other.settings.preset) == other.settings for other in requests.values()):
            requests[name] = replace(undecided, settings=settings)
    return requests


def _seeded(request: Train, seed: int) -> Train:
    run = request.run.with_name(f"{request.run.name}-{seed}")
    return replace(request, run=run, settings=replace(request.settings, seed=seed))


def _write_report(capture: Path, by_seed: Mapping[int, Mapping[str, BenchmarkRun]], seconds: float, out: Path) -> str:
    """Write what is finished so far; returns the report."""
    names = list(by_seed[0])
    found = [outcome_of(name, of_seed[name]) for name in names for of_seed in by_seed.values()]
    outcomes = [outcome for outcome in found if outcome is not None]
    curves = mean_curves(outcomes)
    report = report_text(outcomes, curves, seconds, capture)
    with replacing(out / "report.txt") as partial:
        partial.write_text(report + "\n", encoding="utf-8")
    write_json(out / "benchmark.json", _as_json(outcomes, seconds))
    _write_csv(out / "benchmark.csv", outcomes)
    if curves:
        fitted = any(one.fits_exposure for of_seed in by_seed.values() for one in of_seed.values())
        views = "held-out views, exposure not fitted" if fitted else "held-out views"
        title = f"{capture.name}: PSNR on {views}, {len(by_seed)} seeds; bold: Pareto front"
        with replacing(out / "benchmark.png") as partial:
            benchmark_chart(curves, title).savefig(partial, format="png")
    return report


def report_text(outcomes: Sequence[Outcome], curves: Mapping[str, MeanCurve], seconds: float, capture: Path) -> str:
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
    spans = [f"{name} {format_duration(start)}–{format_duration(end)}" for name, start, end in pareto_front(curves)]
    hit, checked = count_forecasts(runs)
    if any("val_psnr_unmatched" in row for row in table.values()):
        lines.append("The exposure of held-out cameras is fitted for all variants, but not in columns called unfitted.")
    lines += [f"Pareto front of PSNR over time: {', '.join(spans)}."] if spans else []
    lines += [f"Forecasts correct within their error: {hit} of {checked} ({hit / checked:.0%})."] if checked else []
    share = float(np.mean([evaluation_share(outcome.lines) for outcome in runs]))
    lines.append(f"Evaluation while training took {share:.1%} of the training time, which excludes it.")
    return "\n".join(lines)


def table_lines(table: Mapping[str, Mapping[str, Spread]]) -> list[str]:
    """Lines of an aligned Markdown table."""
    shown = [name for name in COLUMNS if any(name in row for row in table.values())]
    reference = table.get(STANDARD, {}).get("val_psnr")
    rows = [["variant", *(COLUMNS[name][0] for name in shown)]]
    if reference is not None:
        rows[0].append("Δ val")
    for variant, row in table.items():
        cells = [variant, *(_cell(row.get(name), COLUMNS[name][1]) for name in shown)]
        if reference is not None:
            cells.append(f"{row['val_psnr'].mean - reference.mean:+.2f}" if "val_psnr" in row else "")
        rows.append(cells)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    rows.insert(1, ["-" * width for width in widths])
    return [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]


def _cell(value: Spread | None, decimals: int) -> str:
    if value is None:
        return ""
    spread = "" if decimals < 2 or np.isnan(value.spread) else f" ± {value.spread:.{decimals}f}"
    return f"{value.mean:,.{decimals}f}{spread}"


def _comparisons(table: Mapping[str, Mapping[str, Spread]]) -> list[str]:
    """Neighbors in the ranking by held-out PSNR that differ by no more than their spread."""
    ranked = sorted(
        ((row["val_psnr"], name) for name, row in table.items() if "val_psnr" in row), key=lambda pair: -pair[0].mean
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
        {"variant": outcome.variant, "seed": outcome.seed, **{k: v for k, v in line.items() if k != "forecast"}}
        for outcome in outcomes
        for line in outcome.lines
    ]
    names = list(dict.fromkeys(name for row in rows for name in row))
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        writer.writerows(rows)
