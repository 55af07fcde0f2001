"""Benchmark of effect plans: effects decided automatically against all effects, at the same number
of iterations.

    python benchmarks/effects.py CAPTURE [--flame FILE] [--iterations 500] [--seeds 3]
        [--only full static one-camera]
    python benchmarks/effects.py CAPTURE … --each
    python benchmarks/effects.py CAPTURE … --switch strain-color view-color [--together]
        [--picture FILE] [--only full uneven]

The first derives two captures from CAPTURE, its first training timestep and its middle training
camera, trains each with the effects decided by Auto and with all that can be on, and says whether
Auto is within 0.1 dB of all, in less time. --each trains with all effects but one, for what each of
them costs. --switch trains with each effect on and off, or with --together all of them, the others
decided by Auto, for what it brings; --picture writes ground truth, off and on of two unseen
timesteps. The capture "uneven" has the channels of each training camera multiplied by 0.9 to 1.1.
Prints tables in Markdown: PSNR of the held-out view, means over seeds ± their standard deviation,
milliseconds of an iteration, and LPIPS with STGA_LPIPS (docs/dependencies.md). Selection is left to
Auto: it is another way to train, not something more to compute. Each seed trains all variants of a
capture in another order. Run it on an idle machine.
"""

import argparse
import json
import random
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from stga_addon.avatar.file import Avatar, read_avatar
from stga_addon.capture.images import read_image
from stga_addon.capture.model import Capture
from stga_addon.capture.open import open_capture
from stga_addon.development.benchmark.statistics import Spread, spread_of
from stga_addon.development.demo.run import side_by_side
from stga_addon.render.render import render_avatar, to_uint8
from stga_addon.training.effect_catalog import EFFECTS
from stga_addon.training.effects.facts import CaptureFacts
from stga_addon.training.effects.plan import RULES, plan_effects
from stga_addon.training.evaluate.metrics import Quality, evaluate_avatar
from stga_addon.training.run.folder import Run, with_refined_tracking
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train
from stga_addon.training.settings import make_settings

LEFT_TO_AUTO = ("selection",)
DIFFERING = ("full", "static", "one-camera")
MAX_LOSS_DB = 0.1
"""Of the automatic plan against all effects."""

Choices = dict[str, str]
Result = tuple[Capture, Avatar, dict[str, Quality], float, str]
"""Of `trained`."""


@dataclass(frozen=True)
class Outcome:
    """Result of a variant over seeds: PSNR in dB and LPIPS by split, milliseconds per iteration,
    effects that were on, and the first avatar with the capture as it was refined."""

    psnr: Mapping[str, Spread]
    lpips: Mapping[str, Spread]
    pace: Spread
    on: str
    avatar: Avatar
    capture: Capture


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


def uneven(root: Path, folder: Path) -> Path:
    """The capture, which must have masks, with different color gains for each training camera."""
    derive(root, folder, lambda split, frame: True)
    path = folder / "transforms_train.json"
    document = json.loads(path.read_text("utf-8"))
    for number, frame in enumerate(document["frames"]):
        gain = np.random.default_rng(frame["camera_index"]).uniform(0.9, 1.1, 3)
        image = np.asarray(Image.open(root / frame["file_path"]).convert("RGB"), np.float32)
        cover = (
            np.asarray(Image.open(root / frame["fg_mask_path"]).convert("L"), np.float32)[..., None]
            / 255
        )
        image *= 1 + cover * (gain - 1)  # the background was replaced after recording
        frame["file_path"] = f"uneven_{number:05d}.png"
        Image.fromarray(np.clip(image + 0.5, 0, 255).astype(np.uint8)).save(
            folder / frame["file_path"]
        )
    path.write_text(json.dumps(document), "utf-8")
    return folder


def captures(root: Path, folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Name -> folder: the capture itself, one timestep of it, one camera of it, and with unlike
    cameras."""
    frames = json.loads((root / "transforms_train.json").read_text("utf-8"))["frames"]
    first = min(frame["timestep_index"] for frame in frames)
    cameras = sorted({frame["camera_index"] for frame in frames})
    middle = cameras[len(cameras) // 2]
    made: dict[str, Callable[[], Path]] = {
        "full": lambda: root,
        "static": lambda: derive(
            root, folder / "static", lambda split, frame: frame["timestep_index"] == first
        ),
        "one-camera": lambda: derive(
            root,
            folder / "one-camera",
            lambda split, frame: split != "train" or frame["camera_index"] == middle,
        ),
        "uneven": lambda: uneven(root, folder / "uneven"),
    }
    return {name: made[name]() for name in names}


def possible(capture: Capture, iterations: int) -> list[str]:
    """The effects that can be on."""
    facts = CaptureFacts(capture, make_settings(iterations=iterations))
    looked = {
        effect.name: RULES[effect.name](facts)
        for effect in EFFECTS.values()
        if effect.name not in LEFT_TO_AUTO
    }
    return [
        name
        for name, verdict in looked.items()
        if verdict is not None and (verdict.on or not verdict.fixed)
    ]


def trained(
    capture: Capture,
    flame: Path | None,
    iterations: int,
    choices: Choices,
    seed: int = 0,
    matched: bool = False,
) -> tuple[Capture, Avatar, dict[str, Quality], float, str]:
    """The capture as it was refined, the avatar, its quality by split, milliseconds of an
    iteration, and the effects that were on."""
    settings, plan = plan_effects(
        capture, make_settings(iterations=iterations, seed=seed, effects=choices)
    )
    with tempfile.TemporaryDirectory() as folder:
        avatar = read_avatar(
            train(capture, Path(folder), Run(capture.root, flame, "vhap", settings, plan))
        )
        seconds = read_metrics(Path(folder))[-1]["seconds"]
        shown = with_refined_tracking(capture, Path(folder), fitted=False)
    splits = [split for split in ("val", "test") if shown.views.get(split)]
    found = {split: evaluate_avatar(avatar, shown, split, True, matched) for split in splits}
    return (
        shown,
        avatar,
        found,
        1000 * seconds / iterations,
        ", ".join(decision.effect for decision in plan if decision.on),
    )


def compare(
    capture: Capture,
    flame: Path | None,
    iterations: int,
    seeds: int,
    variants: Mapping[str, Choices],
) -> dict[str, Outcome]:
    """Variant -> its result."""
    found: dict[str, list[Result]] = {name: [] for name in variants}
    for seed in range(seeds):
        for name in random.Random(seed).sample(list(variants), len(variants)):
            # Exposure matched for all variants, so that those with and without the effect
            # `exposure` compare.
            result = trained(capture, flame, iterations, variants[name], seed, matched=True)
            found[name].append(result)
            _, _, quality, pace, on = result
            scores = ", ".join(f"{split} {each.psnr:.2f} dB" for split, each in quality.items())
            print(
                f"{capture.root.name}, {name}, seed {seed}: {scores}, {pace:.1f} ms: {on}",
                file=sys.stderr,
            )
    return {name: _outcome(runs) for name, runs in found.items()}


def _outcome(runs: Sequence[Result]) -> Outcome:
    def spread(name: str) -> dict[str, Spread]:
        by_split = {split: [getattr(run[2][split], name) for run in runs] for split in runs[0][2]}
        return {
            split: spread_of(values) for split, values in by_split.items() if None not in values
        }

    shown, avatar, _, _, on = runs[0]
    return Outcome(
        spread("psnr"), spread("lpips"), spread_of([run[3] for run in runs]), on, avatar, shown
    )


def write_picture(path: Path, on: Outcome, off: Outcome) -> None:
    """Ground truth, off and on of two unseen timesteps, in the view of the camera in the middle."""
    views = on.capture.views["test"]
    cameras = sorted({view.camera_index for view in views})
    middle = [view for view in views if view.camera_index == cameras[len(cameras) // 2]]
    pictures = []
    for view in (middle[0], middle[-1]):
        pictures.append(read_image(view))
        for each in (off, on):
            mesh = each.capture.mesh(view.timestep)
            image = render_avatar(each.avatar, mesh, view.camera, each.avatar.background)
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
    parser.add_argument("--only", nargs="+", choices=(*DIFFERING, "uneven"))
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--each", action="store_true")
    what.add_argument("--switch", nargs="+", choices=tuple(EFFECTS), metavar="EFFECT")
    parser.add_argument("--together", action="store_true")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    table = each if options.each else switch if options.switch else auto_and_all
    names = options.only or (DIFFERING if table is auto_and_all else ("full",))
    with tempfile.TemporaryDirectory() as folder:
        opened = {
            name: open_capture(root, options.flame)
            for name, root in captures(options.capture.resolve(), Path(folder), names).items()
        }
        table(opened, options)


def auto_and_all(opened: Mapping[str, Capture], options: argparse.Namespace) -> None:
    """One row per capture: is the automatic plan as good as all effects?"""
    row(
        "capture",
        "Auto, val",
        "all on, val",
        "Δ",
        "Auto, ms",
        "all on, ms",
        "Auto is right",
        "only by all on",
    )
    row(*["---"] * 8)
    for name, capture in opened.items():
        everything = dict.fromkeys(possible(capture, options.iterations), "on")
        variants: dict[str, Choices] = {"Auto": {}, "all on": everything}
        auto, every = compare(
            capture, options.flame, options.iterations, options.seeds, variants
        ).values()
        difference = auto.psnr["val"].mean - every.psnr["val"].mean
        more = [effect for effect in every.on.split(", ") if effect not in auto.on.split(", ")]
        right = not more or (difference > -MAX_LOSS_DB and auto.pace.mean < every.pace.mean)
        row(
            *(name, cell(auto.psnr["val"], 2), cell(every.psnr["val"], 2), f"{difference:+.2f}"),
            *(cell(auto.pace, 1), cell(every.pace, 1), "yes" if right else "no"),
            ", ".join(more) or "nothing",
        )


def each(opened: Mapping[str, Capture], options: argparse.Namespace) -> None:
    """One row per effect: quality and time without it."""
    for name, capture in opened.items():
        everything = dict.fromkeys(possible(capture, options.iterations), "on")
        variants = {
            effect: {**everything, effect: "off"} for effect in everything if changes(effect)
        }
        outcomes = compare(
            capture,
            options.flame,
            options.iterations,
            options.seeds,
            {"all on": everything, **variants, "Auto": {}},
        )
        every = outcomes["all on"]
        row(f"{name}, without", "val", "Δ", "ms", "saved")
        row(*["---"] * 5)
        for variant, outcome in outcomes.items():
            difference = outcome.psnr["val"].mean - every.psnr["val"].mean
            saved = every.pace.mean - outcome.pace.mean
            title = {"all on": "none: all on", "Auto": "(Auto)"}.get(variant, f"`{variant}`")
            row(
                title,
                cell(outcome.psnr["val"], 2),
                f"{difference:+.2f}",
                cell(outcome.pace, 1),
                f"{saved:+.1f}",
            )


def changes(effect: str) -> bool:
    """Whether the effect changes training; those of Blender's rig do not."""
    known = EFFECTS[effect]
    return bool(known.switch or known.off or known.offsets) or effect == "exposure"


def switch(opened: Mapping[str, Capture], options: argparse.Namespace) -> None:
    """One row per effect and capture: quality with the effect against without."""
    row("capture", "effect", "decided", "val, off → on", "test", "LPIPS, test", "ms")
    row(*["---"] * 7)
    for name, capture in opened.items():
        _, plan = plan_effects(capture, make_settings(iterations=options.iterations, effects={}))
        decided = {
            decision.effect: f"{'on' if decision.on else 'off'}: {decision.reason}"
            for decision in plan
        }
        together = [tuple(options.switch)] if options.together else [(n,) for n in options.switch]
        for effects in together:
            variants = {choice: dict.fromkeys(effects, choice) for choice in ("on", "off")}
            on, off = compare(
                capture, options.flame, options.iterations, options.seeds, variants
            ).values()
            gains = [
                f"{cell(off.psnr[split], 2)} → {cell(on.psnr[split], 2)}"
                if split in on.psnr
                else ""
                for split in ("val", "test")
            ]
            change = [cell(each.lpips["test"], 4) for each in (off, on) if "test" in each.lpips]
            reasons = "; ".join(decided[effect] for effect in effects)
            pace = f"{on.pace.mean - off.pace.mean:+.1f}"
            row(
                name,
                ", ".join(f"`{n}`" for n in effects),
                reasons,
                *gains,
                " → ".join(change),
                pace,
            )
            if options.picture:
                write_picture(options.picture, on, off)


if __name__ == "__main__":
    main()
