"""Train an avatar from a capture, or continue a run."""

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..capture.model import Capture
from ..errors import StgaError
from ..requests.open_head import OpenHead
from ..selection import SelectionOptions
from ..training.effects.decisions import parse_choices
from ..training.settings import PRESETS, SCHEDULES, STRATEGIES, make_settings
from .arguments import add_capture, add_device, add_effects, duration, real_number, usable_path, whole_number
from .inputs import open_named_capture
from .table import print_table

if TYPE_CHECKING:
    from ..training.run.folder import Run

NAME, HELP = "train", "train an avatar from a capture"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    parser.add_argument("--out", type=usable_path, required=True, metavar="RUN", help="folder of the run")
    add_training(parser)
    parser.add_argument("--resume", action="store_true", help="continue the run in the folder")


def add_training(parser: ArgumentParser) -> None:
    """How a new run is trained."""
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--budget", type=duration, metavar="TIME", help="training time such as 90s, 10m (default 2m)")
    budget.add_argument("--iterations", type=whole_number(1), help="number of iterations instead")
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        help="default: global, which measured best (docs/results.md); selective with --schedule paper",
    )
    parser.add_argument("--schedule", choices=SCHEDULES, help="paper: the settings of the STGA paper")
    parser.add_argument(
        "--preset", choices=tuple(PRESETS), help="quality and training time; `stga presets` shows the times"
    )
    parser.add_argument("--target-psnr", type=real_number, metavar="DB", help="stop when the held-out views reach it")
    parser.add_argument(
        "--stop-when-flat", action="store_true", default=None, help="stop when more time no longer helps"
    )
    parser.add_argument(
        "--threshold",
        type=real_number,
        metavar="METERS",
        help=f"movement from which --strategy selective selects a triangle (default {SelectionOptions.threshold:g}; "
        "0.01 with --schedule paper)",
    )
    add_effects(parser)
    add_device(parser)
    parser.add_argument("--seed", type=whole_number(0), help="fixes every random choice (default 0)")


def run(options: Namespace) -> None:
    run, capture, selection = prepare(options)
    train_run(options.out, run, capture, selection, options.resume, falls_back=options.device == "auto")


def prepare(options: Namespace) -> tuple["Run", Capture, dict[int, np.ndarray] | None]:
    """The run that the options name, its capture and the open head's selection; prints why which device trains.

    Raises StgaError.
    """
    from ..render.device import choose_device
    from ..training.effects.plan import with_effect_plan
    from ..training.run.open_run import device_of, open_run

    if not options.capture.is_dir():
        raise StgaError(f"{options.capture}: is not a folder; expected that of a capture")
    if options.resume:
        opened = open_run(options.out, options.capture, options.flame, options.principal_point)
        run, capture = opened.run, opened.capture
        _refuse_changes(options, run)
        device, why = device_of(run, options.device)
        run = replace(run, device=device)
    else:
        if (options.out / "run.json").exists():
            raise StgaError(f"{options.out}: already holds a run; give --resume to continue it, or another --out")
        device, why = choose_device(options.device)
        capture = open_named_capture(options)
        run = with_effect_plan(_new_run(options, capture, device), capture, device)
    selection = None if options.head is None else options.head.selection()
    print(why)
    return run, capture, None if selection is None else dict(selection)


def train_run(
    folder: Path,
    run: "Run",
    capture: Capture,
    selection: dict[int, np.ndarray] | None,
    resume: bool,
    falls_back: bool,
) -> None:
    """Train a run into its folder with a progress bar, and print its summary."""
    from ..report.run_summary import report_run

    avatar = train_with_bar(folder, run, capture, selection, resume, falls_back)
    for line in report_run(folder):
        print(line)
    print(f"avatar: {avatar}")
    if run.settings.tracking:
        print(f"refined meshes: {folder / 'tracking.npz'} (in Blender: Apply Motion, Own Offsets)")


def train_with_bar(
    folder: Path,
    run: "Run",
    capture: Capture,
    selection: dict[int, np.ndarray] | None,
    resume: bool,
    falls_back: bool,
) -> Path:
    """Train a run into its folder with a progress bar; returns the avatar's path.

    falls_back: see `run.loop.train`.

    Raises StgaError, and KeyboardInterrupt after Ctrl-C when the run can be resumed.
    """
    from ..report.run_summary import CurveUpdater
    from ..training.effects.plan import describe_effects
    from ..training.run.loop import train
    from ..training.run.progress import Progress
    from ..training.run.progress_bar import ProgressBar

    for warning in capture.warnings:
        print(f"warning: {warning}")
    print_table(describe_effects(run.effect_plan))
    draw = CurveUpdater(folder)
    with ProgressBar() as bar:

        def report(progress: Progress) -> bool:
            draw()
            return bar.report(progress)

        return train(capture, folder, run, selection, resume, report, falls_back)


def _refuse_changes(options: Namespace, run: Any) -> None:
    """Raise StgaError for an option that differs from what the run to be resumed began with."""
    settings = run.settings
    began_with = {
        "budget": settings.seconds,
        "iterations": settings.iterations,
        "strategy": settings.strategy,
        "schedule": settings.schedule,
        "threshold": settings.selection.threshold,
        "seed": settings.seed,
        "preset": settings.preset,
        "target_psnr": settings.target_psnr,
        "stop_when_flat": settings.stop_when_flat,
    }
    for name, value in began_with.items():
        if getattr(options, name) not in (None, value):
            option = "--" + name.replace("_", "-")
            raise StgaError(f"{option}: this run began with {value}, which cannot change; use another --out")
    decided = {decision.effect: decision for decision in run.effect_plan}
    for name, choice in parse_choices(options.effect).items():
        if name not in decided or choice not in ("auto", "on" if decided[name].on else "off"):
            raise StgaError(f"--effect {name}={choice}: differs from what was decided for this run; use another --out")


def _new_run(options: Namespace, capture: Capture, device: str) -> Any:
    from ..training.run.folder import Run

    changes: dict[str, Any] = {"target_psnr": options.target_psnr, "stop_when_flat": bool(options.stop_when_flat)}
    if options.seed is not None:
        changes["seed"] = options.seed
    if options.iterations is not None:
        changes["iterations"] = options.iterations
    elif options.budget is not None:
        changes["seconds"] = options.budget
    else:
        changes["seconds"] = 120.0 if options.preset is None else _preset_seconds(capture, options.preset, device)
    if options.strategy is not None:
        changes["strategy"] = options.strategy
    flame = None if options.flame is None else options.flame.resolve()
    choices = parse_choices(options.effect)
    if choices or (options.schedule != "paper" and options.strategy != "gaussian-avatars"):
        changes["effects"] = choices
    settings = make_settings(schedule=options.schedule or "default", preset=options.preset, **changes)
    if options.threshold is not None:
        settings = replace(settings, selection=replace(settings.selection, threshold=options.threshold))
    return Run(options.capture.resolve(), flame, options.principal_point or "vhap", settings, device=device)


def _preset_seconds(capture: Capture, preset: str, device: str) -> float:
    """Seconds that a preset takes on this machine's device, which are printed."""
    from ..format import format_duration
    from ..report.preset_timing import time_presets

    (timing,) = time_presets(capture, [preset], device=device)
    print(f"{preset}: {timing.iterations} iterations, {format_duration(timing.seconds)} on this machine")
    return timing.seconds
