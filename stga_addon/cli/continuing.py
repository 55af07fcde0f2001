"""What the commands that continue a finished run have in common."""

from argparse import ArgumentParser, Namespace
from typing import Any

from ..errors import StgaError
from ..format import format_duration
from ..requests.values import Resume
from ..training.run.folder import has_run, next_folder, read_run
from .arguments import add_device, duration, usable_path, whole_number

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


def continued_run(options: Namespace, default_seconds: float) -> dict[str, Any]:
    """What `Refine` and `Extend` share, by field. Raises StgaError where --out holds a run already."""
    folder = options.out or next_folder(options.run_folder)
    if has_run(folder):
        raise StgaError(f"{folder}: already holds a run; choose another --out, or give --resume and this folder")
    seconds = None if options.iterations is not None else options.budget or default_seconds
    return {
        "run": folder,
        "parent": options.run_folder,
        "growth": options.growth,
        "seconds": seconds,
        "iterations": options.iterations,
        "seed": options.seed,
        "flame": options.flame,
        "device": options.device,
    }


def resumed_continuation(options: Namespace) -> Resume:
    """Raises StgaError for an option that would have no effect, or a run that continues none."""
    for name, shown in BEGUN_WITH.items():
        if getattr(options, name, None):
            raise StgaError(f"{shown}: cannot be combined with --resume, which continues the run in RUN as it began")
    if read_run(options.run_folder).continuation is None:
        raise StgaError(f"{options.run_folder}: does not continue another run; resume it with `stga train --resume`")
    return Resume(options.run_folder, flame=options.flame, device=options.device)
