"""Train an avatar from a capture, or continue a run."""

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from typing import Any

from ..errors import StgaError
from ..requests.open_head import OpenHead
from ..requests.values import Resume, Train
from ..selection import SelectionOptions
from ..training.effect_decisions import parse_choices
from ..training.run.folder import Run, has_run, read_run
from ..training.settings import PRESETS, SCHEDULES, STRATEGIES, TrainingSettings, make_settings
from .arguments import add_capture, add_device, add_effects, duration, real_number, usable_path, whole_number
from .carry_out import carry_out
from .inputs import principal_point_of

NAME, HELP = "train", "train an avatar from a capture"
DEFAULT_SECONDS = 120.0


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
    carry_out(training_request(options))


def training_request(options: Namespace) -> Train | Resume:
    """Raises StgaError for options that do not go together, or that differ from those that a run began with."""
    selection = None if options.head is None else options.head.selection()
    if options.resume:
        refuse_changes(options, read_run(options.out))
        return Resume(
            options.out, options.capture, options.flame, options.principal_point, options.device, selection
        )  # fmt: skip
    if has_run(options.out):
        raise StgaError(f"{options.out}: already holds a run; give --resume to continue it, or another --out")
    settings = training_settings(options)
    return Train(
        options.out,
        options.capture,
        settings,
        options.flame,
        principal_point_of(options),
        device=options.device,
        selection=selection,
    )


def training_settings(options: Namespace) -> TrainingSettings:
    """The settings of a new run. Raises StgaError for options that do not go together, or would have no effect."""
    _refuse_overwritten(options)
    changes: dict[str, Any] = {"target_psnr": options.target_psnr, "stop_when_flat": bool(options.stop_when_flat)}
    if options.iterations is not None:
        changes["iterations"] = options.iterations
    elif options.preset is None or options.budget is not None:
        changes["seconds"] = options.budget or DEFAULT_SECONDS
    for name in ("seed", "strategy"):
        if getattr(options, name) is not None:
            changes[name] = getattr(options, name)
    choices = parse_choices(options.effect)
    if choices or (options.schedule != "paper" and options.strategy != "gaussian-avatars"):
        changes["effects"] = choices
    settings = make_settings(schedule=options.schedule or "default", preset=options.preset, **changes)
    if options.threshold is None:
        return settings
    if settings.strategy != "selective":
        raise StgaError("--threshold: has no effect without --strategy selective, or --schedule paper")
    return replace(settings, selection=replace(settings.selection, threshold=options.threshold))


def _refuse_overwritten(options: Namespace) -> None:
    """Raise StgaError for a choice of settings that another choice replaces."""
    paper, other_method = options.schedule == "paper", options.strategy == "gaussian-avatars"
    for option, is_replaced, by in (
        ("--schedule paper", paper and other_method, "--strategy gaussian-avatars"),
        ("--preset", options.preset and paper, "--schedule paper"),
        ("--preset", options.preset and other_method, "--strategy gaussian-avatars"),
    ):
        if is_replaced:
            raise StgaError(f"{option}: cannot be combined with {by}, which has settings of its own")


def refuse_changes(options: Namespace, run: Run) -> None:
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
