"""Benchmark of effects: each on against off, at the same number of iterations.

    python -m stga_addon.development.benchmark.effects CAPTURE --switch strain-color view-color
        [--together] [--picture FILE] [--flame FILE] [--iterations 500] [--seeds 3]

Trains with each effect on and off, or with --together all of them at once, the others decided by
Auto. Prints a table in Markdown, means over seeds ± their standard deviation: PSNR of the held-out
view (val) and of unseen expressions (test), LPIPS with STGA_LPIPS (docs/dependencies.md), and by
how many milliseconds the effects lengthen an iteration. --picture writes ground truth, off and on
of two unseen timesteps; of several effects, each has a file: shown.jpg becomes
shown-view-color.jpg. Each seed trains the variants in another order. Run it on an idle machine.
"""

import argparse
import random
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from ...avatar.file import Avatar, read_avatar
from ...capture.images import read_image
from ...capture.model import Capture
from ...capture.open import open_capture
from ...render.render import render_avatar, to_uint8
from ...training.effect_catalog import EFFECTS
from ...training.effects.plan import plan_effects
from ...training.evaluate.metrics import Quality, evaluate_avatar
from ...training.run.folder import Run, with_refined_tracking
from ...training.run.metrics_log import read_metrics
from ...training.run.session import train_run
from ...training.settings import make_settings
from ..demo.run import side_by_side
from .statistics import Spread, spread_of

Choices = dict[str, str]


@dataclass(frozen=True)
class Trained:
    """An avatar that was trained for the benchmark.

    capture   as it was refined; quality: by split; pace: milliseconds an iteration
    """

    capture: Capture
    avatar: Avatar
    quality: Mapping[str, Quality]
    pace: float


@dataclass(frozen=True)
class Outcome:
    """Results of a variant over seeds: PSNR in dB and LPIPS by split, milliseconds an iteration,
    and what the first seed made."""

    psnr: Mapping[str, Spread]
    lpips: Mapping[str, Spread]
    pace: Spread
    first: Trained


def trained(
    capture: Capture, flame: Path | None, iterations: int, choices: Choices, seed: int
) -> Trained:
    """An avatar with effects as chosen, measured with matched exposure: with and without the effect
    `exposure`, it compares."""
    settings, plan = plan_effects(
        capture, make_settings(iterations=iterations, seed=seed, effects=choices)
    )
    with tempfile.TemporaryDirectory() as folder:
        run = Run(capture.root, flame, "vhap", settings, plan)
        avatar = read_avatar(train_run(capture, Path(folder), run).path)
        seconds = read_metrics(Path(folder))[-1]["seconds"]
        refined = with_refined_tracking(capture, Path(folder), fitted=False)
    splits = [split for split in ("val", "test") if refined.views.get(split)]
    quality = {split: evaluate_avatar(avatar, refined, split, True, True) for split in splits}
    return Trained(refined, avatar, quality, 1000 * seconds / iterations)


def on_and_off(
    capture: Capture, effects: Sequence[str], options: argparse.Namespace
) -> list[Outcome]:
    """Outcomes with the effects on, and off."""
    found: dict[str, list[Trained]] = {"on": [], "off": []}
    for seed in range(options.seeds):
        for choice in random.Random(seed).sample(list(found), len(found)):
            choices = dict.fromkeys(effects, choice)
            result = trained(capture, options.flame, options.iterations, choices, seed)
            found[choice].append(result)
            scores = ", ".join(f"{split} {q.psnr:.2f} dB" for split, q in result.quality.items())
            print(f"{choice}, seed {seed}: {scores}, {result.pace:.1f} ms", file=sys.stderr)
    return [_outcome(runs) for runs in found.values()]


def _outcome(runs: Sequence[Trained]) -> Outcome:
    def spread(name: str) -> dict[str, Spread]:
        splits = runs[0].quality
        by_split = {split: [getattr(run.quality[split], name) for run in runs] for split in splits}
        return {
            split: spread_of(values) for split, values in by_split.items() if None not in values
        }

    return Outcome(spread("psnr"), spread("lpips"), spread_of([run.pace for run in runs]), runs[0])


def write_picture(path: Path, on: Outcome, off: Outcome) -> None:
    """Ground truth, off and on of two unseen timesteps, in the view of the camera in the middle."""
    views = on.first.capture.views["test"]
    cameras = sorted({view.camera_index for view in views})
    middle = [view for view in views if view.camera_index == cameras[len(cameras) // 2]]
    pictures = []
    for view in (middle[0], middle[-1]):
        pictures.append(read_image(view))
        for each in (off, on):
            mesh = each.first.capture.mesh(view.timestep)
            avatar = each.first.avatar
            image = render_avatar(avatar, mesh, view.camera, avatar.background)
            pictures.append(to_uint8(image))
    Image.fromarray(side_by_side(pictures)).save(path, quality=92)


def cell(value: Spread, decimals: int) -> str:
    return f"{value.mean:.{decimals}f}" + (
        f"±{value.spread:.{decimals}f}" if value.count > 1 else ""
    )


def row(*cells: str) -> None:
    print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--flame", type=Path)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--switch", nargs="+", choices=tuple(EFFECTS), metavar="EFFECT", required=True
    )
    parser.add_argument("--together", action="store_true")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    capture = open_capture(options.capture.resolve(), options.flame)
    if options.picture and not capture.views.get("test"):
        parser.error("--picture shows test views, and the capture has none")
    _, plan = plan_effects(capture, make_settings(iterations=options.iterations, effects={}))
    decided = {each.effect: f"{'on' if each.on else 'off'}: {each.reason}" for each in plan}
    header = ["effect", "Auto's decision", "PSNR val, off → on", "PSNR test, off → on"]
    row(*header, "LPIPS test, off → on", "ms, on − off")
    row(*["---"] * 6)
    trainings = [options.switch] if options.together else [[name] for name in options.switch]
    for effects in trainings:
        on, off = on_and_off(capture, effects, options)
        gains = [
            f"{cell(off.psnr[split], 2)} → {cell(on.psnr[split], 2)}" if split in on.psnr else ""
            for split in ("val", "test")
        ]
        change = [cell(each.lpips["test"], 4) for each in (off, on) if "test" in each.lpips]
        row(
            ", ".join(f"`{name}`" for name in effects),
            "; ".join(decided[name] for name in effects),
            *gains,
            " → ".join(change),
            f"{on.pace.mean - off.pace.mean:+.1f}",
        )
        if options.picture:
            path = options.picture
            if len(trainings) > 1:
                path = path.with_stem(f"{path.stem}-{effects[0]}")
            write_picture(path, on, off)


if __name__ == "__main__":
    main()
