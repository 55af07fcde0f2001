"""What accuracy costs in time: variants trained for the same wall time, in turns, and what came of them."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ...capture.model import Capture
from ...effects.plan import with_effect_plan
from ...files import replacing, write_json
from ...format import format_duration
from ...report.run_summary import evaluation_share
from ...training.run.folder import Run
from ...training.settings import TrainingSettings
from .chart import benchmark_chart
from .scheduler import BenchmarkRun, Tell, race
from .statistics import (
    MeanCurve,
    Outcome,
    Spread,
    alike,
    forecasts_checked,
    leaders,
    mean_curves,
    outcome_of,
    summarise,
)
from .variants import STANDARD, Changes, settings_of

COLUMNS = {
    "iterations": ("iterations", 0),
    "ms_per_iteration": ("ms/it", 1),
    "splats": ("splats", 0),
    "peak_memory_mb": ("MB", 0),
    "val_psnr": ("val", 2),
    "val_psnr_mask": ("head", 2),
    "val_psnr_moving": ("moving", 2),
    "val_ssim": ("SSIM", 4),
    "val_lpips": ("LPIPS", 4),
    "test_psnr": ("test", 2),
    "test_psnr_moving": ("moving", 2),
}
"""Figure -> heading and decimals. PSNR in dB on held-out views (val) and unseen expressions (test)."""


def run_benchmark(
    capture: Capture,
    run: Run,
    variants: Mapping[str, Changes],
    seconds: float,
    seeds: int,
    out: Path,
    tell: Tell = print,
) -> str:
    """Train every variant for `seconds` with each seed; returns the report, which is also written to `out`.

    run: how `capture` is opened again; its settings do not matter. Leaves report.txt, benchmark.json, benchmark.csv and
    benchmark.png beside the runs. What is done is kept and reported when this is interrupted, and taken up again when
    it is called again. Raises StgaError where `out` holds a benchmark of other settings.
    """
    tell("deciding about effects")
    runs = _runs(capture, run, variants, seconds)
    jobs = {seed: {name: _job(run, name, seed, out) for name, run in runs.items()} for seed in range(seeds)}
    for of_seed in jobs.values():
        for job in of_seed.values():
            job.check()
    left = sum(not job.finished for of_seed in jobs.values() for job in of_seed.values())
    if left:
        each, total = format_duration(seconds), format_duration(left * seconds)
        tell(f"{left} runs of {each}: {total} of training; what starting and measuring take is on top")
    try:
        for seed, of_seed in jobs.items():
            if not all(job.finished for job in of_seed.values()):
                race(list(of_seed.values()), lambda text, seed=seed: tell(f"seed {seed}: {text}"))  # type: ignore[misc]
    except KeyboardInterrupt:
        tell(f"what is finished stands in {out / 'report.txt'}; the same command goes on from here")
        raise
    finally:
        report = _write(run, jobs, seconds, out)
    return report


def _runs(capture: Capture, run: Run, variants: Mapping[str, Changes], seconds: float) -> dict[str, Run]:
    """variant -> its run; one that would train as an earlier one does is left out."""
    runs: dict[str, Run] = {}
    for name, changes in variants.items():
        decided = with_effect_plan(replace(run, settings=settings_of(changes, seconds)), capture)
        if not any(_same(decided.settings, other.settings) for other in runs.values()):
            runs[name] = decided
    return runs


def _same(a: TrainingSettings, b: TrainingSettings) -> bool:
    return replace(a, preset=None, effects=None) == replace(b, preset=None, effects=None)


def _job(run: Run, name: str, seed: int, out: Path) -> BenchmarkRun:
    return BenchmarkRun(replace(run, settings=replace(run.settings, seed=seed)), out / f"{name}-{seed}")


def _write(run: Run, jobs: Mapping[int, Mapping[str, BenchmarkRun]], seconds: float, out: Path) -> str:
    """Write down whatever there is, and return the report."""
    names = list(jobs[0])
    found = [outcome_of(name, of_seed[name]) for name in names for of_seed in jobs.values()]
    outcomes = [outcome for outcome in found if outcome is not None]
    curves = mean_curves(outcomes)
    report = report_text(outcomes, curves, seconds, run.capture)
    with replacing(out / "report.txt") as partial:
        partial.write_text(report + "\n", encoding="utf-8")
    write_json(out / "benchmark.json", _as_json(outcomes, seconds))
    _write_csv(out / "benchmark.csv", outcomes)
    if curves:
        title = f"{run.capture.name}: PSNR on held-out views, {len(jobs)} seeds; bold is best for its time"
        with replacing(out / "benchmark.png") as partial:
            benchmark_chart(curves, title).savefig(partial, format="png")
    return report


def report_text(outcomes: Sequence[Outcome], curves: Mapping[str, MeanCurve], seconds: float, capture: Path) -> str:
    """The table and what it shows, for the terminal and for a document."""
    table = summarise(outcomes)
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
    spans = [f"{name} {format_duration(start)}–{format_duration(end)}" for name, start, end in leaders(curves)]
    hit, checked = forecasts_checked(runs)
    lines += [f"Best for its time (Pareto front): {', '.join(spans)}."] if spans else []
    lines += (
        [f"Forecasts that came true within their error: {hit} of {checked} ({hit / checked:.0%})."] if checked else []
    )
    share = float(np.mean([evaluation_share(outcome.lines) for outcome in runs]))
    lines.append(f"Evaluation while training took {share:.1%} of the training time, which does not count it.")
    return "\n".join(lines)


def table_lines(table: Mapping[str, Mapping[str, Spread]]) -> list[str]:
    """A Markdown table, its columns aligned."""
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
    # How far counts scatter over seeds says little.
    spread = "" if decimals < 2 or np.isnan(value.spread) else f" ± {value.spread:.{decimals}f}"
    return f"{value.mean:,.{decimals}f}{spread}"


def _comparisons(table: Mapping[str, Mapping[str, Spread]]) -> list[str]:
    """Which neighbours in the ranking by held-out PSNR differ by no more than their spread."""
    ranked = sorted(
        ((row["val_psnr"], name) for name, row in table.items() if "val_psnr" in row), key=lambda pair: -pair[0].mean
    )
    if any(value.count < 2 for value, _ in ranked):
        return ["One seed shows no spread: differences under about 0.3 dB mean little."]
    lines = [
        f"{first} and {second} are {a.mean - b.mean:.2f} dB apart, within their spread: no difference is shown."
        for (a, first), (b, second) in pairwise(ranked)
        if alike(a, b)
    ]
    return lines or ["All neighbours in the ranking are farther apart than their spread."]


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
    """One row an evaluation: everything that its metrics line holds."""
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
