"""Compares ways to extend an avatar by a take, and to refine a region of it, at equal training
time.

    python -m stga_addon.development.benchmark.extend CAPTURE [--flame FILE] [--base 1500]
        [--seconds 60] [--seeds 0 1 2] [--refine mouth] [--report FILE]

The training timesteps are split into two takes, alternating by how much of the face moves. An
avatar is trained on the first; each arm then continues it for the same time, but training anew on
both takes has three times as long. With --refine, arms that train this region of the same avatar
follow. PSNR of held-out views in dB: whole image and moving region of the old and the new take, and
the region. Ends with a table of all seeds and the differences that matter. Runs and figures stay in
--folder; the training on the first take is not repeated.
"""

import argparse
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ...capture.loader import ViewLoader
from ...capture.model import View
from ...capture.open import open_capture
from ...capture.selection import SelectionOptions, select_capture
from ...jobs.train import Extend, Prepared, Refine, prepare
from ...progress import ignore
from ...training.effects.plan import add_effects, plan_effects
from ...training.evaluate.metrics import evaluate, known_exposure
from ...training.optimize.image_preparation import image_preparation
from ...training.optimize.precompile import precompile_kernels
from ...training.optimize.trainer import Start, Strategy, Trainer
from ...training.run.continuation import (
    continued_order,
    grouped_evaluation_views,
    starting_state,
)
from ...training.run.folder import Run, read_run
from ...training.run.session import train_run
from ...training.schedule import view_order
from ...training.settings import TrainingSettings, make_settings

EVALUATIONS = 6
"""Evaluations of an arm after the first."""
ANEW_BUDGET = 3
"""Time of training anew on both takes, as a multiple of the other arms'."""
Line = dict[str, Any]
"""A line of quality: arm, seconds, iterations and what `Quality.as_json` gives."""
FIGURES = ("take_1", "moving_take_1", "take_2", "moving_take_2", "region")


@dataclass(frozen=True)
class Arm:
    """A way to go on: settings, which views, and which splats. anew: with new splats instead of the
    avatar's."""

    settings: TrainingSettings
    views: Iterator[View]
    strategy: Strategy
    anew: bool = False


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--flame", type=Path)
    parser.add_argument("--base", type=int, default=1500, help="iterations on the first take")
    parser.add_argument("--seconds", type=float, default=60.0, help="time of each arm")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument(
        "--refine", metavar="REGION", help="compare refinements of this region, too"
    )
    parser.add_argument("--folder", type=Path, default=Path("out/extend"))
    parser.add_argument(
        "--report", type=Path, help="also write the tables of all seeds into this file"
    )
    options = parser.parse_args()
    precompile_kernels()
    options.folder.mkdir(parents=True, exist_ok=True)
    runs: dict[str, dict[str, list[list[Line]]]] = {}
    for seed in options.seeds:
        for kind, prepared, arms in comparisons(options, seed):
            for name, arm in arms.items():
                of_seeds = runs.setdefault(kind, {}).setdefault(name, [])
                of_seeds.append(compare(name, prepared, arm, options))
    report = "\n\n".join(
        "\n".join([*table(of_kind), "", *differences(of_kind)]) for of_kind in runs.values()
    )
    print(f"\n{report}")
    if options.report is not None:
        options.report.write_text(report + "\n", encoding="utf-8")


def comparisons(
    options: argparse.Namespace, seed: int
) -> Iterator[tuple[str, Prepared, dict[str, Arm]]]:
    """What is compared with one seed: "extend" and, where a region is given, "refine"; the arms of
    each."""
    unused = options.folder / "unused"
    old, new = split_takes(options.capture, options.flame, options.folder / options.capture.name)
    parent = trained(old, options, seed)
    given: dict[str, Any] = {"seconds": options.seconds, "seed": seed, "device": "cpu"}
    prepared = prepare(Extend(unused, parent, (new,), **given), ignore, print)
    settings, plan = add_effects(prepared.capture, prepared.run.settings, prepared.run.effect_plan)
    prepared = replace(prepared, run=replace(prepared.run, settings=settings, effect_plan=plan))
    yield "extend", prepared, extend_arms(prepared, seed)
    if options.refine:
        prepared = prepare(Refine(unused, parent, options.refine, **given), ignore, print)
        yield "refine", prepared, refine_arms(prepared, seed)


def split_takes(root: Path, flame: Path | None, folder: Path) -> tuple[Path, Path]:
    """Two captures with every other training timestep each; their files are links into the whole
    one."""
    capture = open_capture(root, flame)
    timesteps = sorted({view.timestep for view in capture.views["train"]})
    selection = select_capture(capture, SelectionOptions())
    ranked = sorted(timesteps, key=lambda timestep: selection[timestep].mean())
    first = ranked[::2]
    second = ranked[1::2]
    return (
        derive(
            root,
            folder / "old",
            lambda split, frame: split != "test" and frame["timestep_index"] in first,
        ),
        derive(
            root,
            folder / "new",
            lambda split, frame: split != "test" and frame["timestep_index"] in second,
        ),
    )


def derive(root: Path, folder: Path, keep: Callable[[str, dict[str, Any]], bool]) -> Path:
    """A capture of those frames of another that `keep(split, frame)` chooses; its files are
    links."""
    folder.mkdir(parents=True, exist_ok=True)
    for item in root.resolve().iterdir():
        if not item.name.startswith("transforms") and not (folder / item.name).exists():
            (folder / item.name).symlink_to(item)
    for split in ("train", "val", "test"):
        path = root / f"transforms_{split}.json"
        document = json.loads(path.read_text("utf-8")) if path.exists() else {"frames": []}
        document["frames"] = [frame for frame in document["frames"] if keep(split, frame)]
        (folder / path.name).write_text(json.dumps(document), "utf-8")
    return folder


def trained(take: Path, options: argparse.Namespace, seed: int) -> Path:
    """The run of the first take."""
    folder: Path = options.folder / options.capture.name / f"base_{options.base}_{seed}"
    if not (folder / "residuals.npz").exists():
        capture = open_capture(take, options.flame)
        settings = make_settings(iterations=options.base, seed=seed, effects={"tracking": "off"})
        run = Run(capture.root, options.flame, "vhap", *plan_effects(capture, settings))
        train_run(capture, folder, run, resume=(folder / "run.json").exists())
    return folder


def extend_arms(prepared: Prepared, seed: int) -> dict[str, Arm]:
    """Name -> arm."""
    assert prepared.run.continuation is not None
    assert prepared.selection is not None
    settings = prepared.run.settings
    continuation = prepared.run.continuation
    capture = prepared.capture
    parent = read_run(continuation.parent).settings
    views = capture.views["train"]
    every = Strategy(replace(settings, strategy="global"), {})
    anew = replace(parent, driven_offsets=settings.driven_offsets)
    return {
        "extend": Arm(settings, continued_order(continuation, capture, None, seed), every),
        "anew": Arm(anew, view_order(views, 1, seed), every, anew=True),
    }


def refine_arms(prepared: Prepared, seed: int) -> dict[str, Arm]:
    """Name -> arm."""
    assert prepared.run.continuation is not None
    assert prepared.selection is not None
    settings = prepared.run.settings
    continuation = prepared.run.continuation
    capture = prepared.capture
    region = np.any(list(prepared.selection.values()), axis=0)
    base = Trainer(
        capture,
        settings,
        prepared.selection,
        Start(starting_state(continuation, settings, len(capture.faces))),
    )
    every = view_order(capture.views["train"], 1, seed)
    return {
        "refine": Arm(
            settings, continued_order(continuation, capture, region, seed), base.strategy
        ),
        "all": Arm(settings, every, Strategy(replace(settings, strategy="global"), {})),
    }


def compare(name: str, prepared: Prepared, arm: Arm, options: argparse.Namespace) -> list[Line]:
    """Train one arm; returns and prints its quality before, during and after."""
    assert prepared.run.continuation is not None
    capture = prepared.capture
    state = (
        None
        if arm.anew
        else starting_state(prepared.run.continuation, arm.settings, len(prepared.capture.faces))
    )
    trainer = Trainer(capture, arm.settings, prepared.selection or {}, Start(state))
    trainer.strategy = arm.strategy
    region = arm_region(prepared)
    evaluation_views = grouped_evaluation_views(prepared.run, capture, region)
    rows = arm.settings.exposure
    exposure = known_exposure(rows, capture.views["train"]) if rows else None
    spent = 0.0
    due = 0.0
    budget = options.seconds * (ANEW_BUDGET if arm.anew else 1)
    lines: list[Line] = []
    red, green, blue = (round(255 * level) for level in arm.settings.background)
    prepare = image_preparation(capture, arm.settings)
    with ViewLoader(
        arm.views, background=(red, green, blue), prepare=prepare, mesh=capture.mesh
    ) as loader:
        while True:
            if spent >= due:
                fraction = min(1.0, spent / budget) if arm.anew else 1.0
                quality = evaluate(
                    partial(trainer.render, progress=fraction), evaluation_views, exposure=exposure
                )
                lines.append(
                    {
                        "arm": name,
                        "seconds": spent,
                        "iterations": trainer.iteration,
                        **quality.as_json(),
                    }
                )
                print(describe(lines[-1]), flush=True)
                if spent >= budget:
                    break
                due += options.seconds / EVALUATIONS
            begin = perf_counter()
            view, image, mask, mesh = next(loader)
            trainer.step(view, image, min(1.0, spent / budget), mask, mesh)
            spent += perf_counter() - begin
    with (options.folder / f"{options.capture.name}.jsonl").open("a", encoding="utf-8") as out:
        out.writelines(json.dumps({**line, "seed": arm.settings.seed}) + "\n" for line in lines)
    return lines


def arm_region(prepared: Prepared) -> np.ndarray | None:
    if prepared.run.settings.strategy != "refine":
        return None
    assert prepared.selection is not None
    return np.asarray(np.any(list(prepared.selection.values()), axis=0))


def describe(line: dict[str, float]) -> str:
    """One row of the table."""
    figures = "  ".join(
        f"{name} {line[f'psnr_{name}']:.2f}" for name in FIGURES if f"psnr_{name}" in line
    )
    spent = f"{line['arm']:20} {line['seconds']:6.1f} s {line['iterations']:5d} it"
    return f"{spent}  all {line['psnr']:.2f}  {figures}"


def table(runs: dict[str, list[list[Line]]]) -> list[str]:
    """Markdown: PSNR at the end of each arm, mean ± standard deviation over seeds, and the seconds
    to two levels.

    *same*: until the region is as good as all leaves it. *98 %*: until both takes together reach
    98 % of the PSNR that training anew ends with.
    """
    figures = [name for name in FIGURES if f"psnr_{name}" in next(iter(runs.values()))[0][-1]]
    goals = {"98 %": ("psnr", runs.get("anew"), 0.98)}
    if "region" in figures:
        goals = {"same": ("psnr_region", runs.get("all"), 1.0), **goals}
    rows = [["arm", "iterations", "ms", *figures, *(f"s to {goal}" for goal in goals)]]
    for of_seeds in [of_seeds for name, of_seeds in runs.items() if name != "anew"][:1]:
        before = (spread([lines[0][f"psnr_{name}"] for lines in of_seeds]) for name in figures)
        rows.append(["before", "", "", *before, *("" for _ in goals)])
    for arm, of_seeds in runs.items():
        ends = [lines[-1] for lines in of_seeds]
        count, seconds = (
            np.mean([end[name] for end in ends]) for name in ("iterations", "seconds")
        )
        row = [arm, f"{count:.0f}", f"{1000 * seconds / count:.0f}"]
        row += [spread([end[f"psnr_{name}"] for end in ends]) for name in figures]
        for quality, others, fraction in goals.values():
            pairs = zip(of_seeds, others or [], strict=False)
            row.append(
                spread(
                    [
                        time_to(lines, quality, fraction * other[-1][quality])
                        for lines, other in pairs
                    ],
                    1,
                )
            )
        rows.append(row)
    rows.insert(1, ["---"] * len(rows[0]))
    return ["| " + " | ".join(row) + " |" for row in rows]


def differences(runs: dict[str, list[list[Line]]]) -> list[str]:
    """What each arm gains in the new take beside what it pays in the old one, and how long the
    continuation takes."""
    found = list[str]()
    if {"extend", "anew"} <= set(runs):
        pairs = list(zip(runs["extend"], runs["anew"], strict=True))
        fractions = [
            time_to(lines, "psnr", 0.98 * anew[-1]["psnr"]) / anew[-1]["seconds"]
            for lines, anew in pairs
        ]
        percent = spread([100 * fraction for fraction in fractions], 1)
        found.append(f"- 98 % of the PSNR of anew: after {percent} % of its time")
    for name, of_seeds in runs.items():
        if "refine" in name and "psnr_region" in of_seeds[0][-1]:
            gains = [lines[-1]["psnr_region"] - lines[0]["psnr_region"] for lines in of_seeds]
            found.append(f"- region: {name} over before {spread(gains)} dB")
    return found


def spread(values: list[float], digits: int = 2) -> str:
    """Mean ± standard deviation; empty without values, a dash where one of them is infinite."""
    if not values:
        return ""
    if not np.isfinite(values).all():
        return "–"
    deviation = f"±{np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{deviation}"


def time_to(lines: list[Line], quality: str, level: float) -> float:
    """Seconds until the quality is first reached, between two evaluations by interpolation;
    infinite if never."""
    for before, after in pairwise(lines):
        low = before[quality]
        high = after[quality]
        if high >= level:
            part = 0.0 if low >= level else (level - low) / (high - low)
            return float(before["seconds"] + part * (after["seconds"] - before["seconds"]))
    return float("inf")


if __name__ == "__main__":
    os.environ.setdefault("STGA_LPIPS", "")
    main()
