"""What the commands that continue a finished run have in common."""

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..format import format_duration
from .arguments import add_device, duration, usable_path, whole_number
from .train import train_run

BEGUN_WITH = {
    "takes": "CAPTURE",
    "select_only": "--select-only",
    **{name: f"--{name}" for name in ("region", "frames", "growth", "out", "budget", "iterations", "seed")},
}
"""Options that a continuation begins with, which resuming it cannot change, and how a message names them."""


def add_continued_run(parser: ArgumentParser, default_seconds: float) -> None:
    parser.add_argument("run_folder", type=usable_path, metavar="RUN", help="folder of a run")
    parser.add_argument(
        "--out", type=usable_path, metavar="NEW", help="folder of the run that continues it (default: RUN_2, RUN_3, …)"
    )
    budget = parser.add_mutually_exclusive_group()
    default = format_duration(default_seconds)
    budget.add_argument("--budget", type=duration, metavar="TIME", help=f"training time (default {default})")
    budget.add_argument("--iterations", type=whole_number(1), help="number of iterations instead")
    parser.add_argument("--flame", type=usable_path, metavar="FILE", help="FLAME model file, if it has moved")
    parser.add_argument("--resume", action="store_true", help="RUN was stopped: continue it")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="fixes every random choice (default 0)")
    add_device(parser)


def continuation_folder(options: Namespace) -> tuple[Path, str]:
    """The folder of the run to be made, and the device that trains it; both are printed.

    Raises StgaError where the folder holds a run already.
    """
    from ..training.run.folder import next_folder, read_run
    from ..training.run.open_run import device_of

    folder = options.out or next_folder(options.run_folder)
    if (folder / "run.json").exists():
        raise StgaError(f"{folder}: already holds a run; choose another --out, or give --resume and this folder")
    device, why = device_of(read_run(options.run_folder), options.device)
    print(f"{why}\nrun: {folder}")
    return folder, device


def budget_of(options: Namespace, default_seconds: float) -> dict[str, Any]:
    """Budget and seed, as fields of what is asked for."""
    if options.iterations is not None:
        return {"iterations": options.iterations, "seed": options.seed}
    return {"seconds": options.budget or default_seconds, "seed": options.seed}


def resume_continuation(options: Namespace) -> None:
    """Continue a run that was stopped. Raises StgaError for an option that would have no effect."""
    from dataclasses import replace

    from ..training.run.open_run import device_of, open_run

    for name, shown in BEGUN_WITH.items():
        if getattr(options, name, None):
            raise StgaError(f"{shown}: cannot be combined with --resume, which continues the run in RUN as it began")
    opened = open_run(options.run_folder, flame=options.flame)
    if opened.run.continuation is None:
        raise StgaError(f"{options.run_folder}: does not continue another run; resume it with `stga train --resume`")
    device, why = device_of(opened.run, options.device)
    print(why)
    run = replace(opened.run, device=device)
    train_run(options.run_folder, run, opened.capture, None, resume=True, falls_back=options.device == "auto")
