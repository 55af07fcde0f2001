"""Extend a finished avatar by further takes of the same head, in a run of its own."""

from argparse import ArgumentParser, Namespace

import numpy as np

from ..errors import StgaError
from ..jobs.delegate import OpenHead
from .arguments import real_number, usable_path
from .continuing import add_continued_run, budget_of, continuation_folder, resume_continuation
from .train import train_run

NAME, HELP = "extend", "extend a finished avatar by further takes of the same head"
DEFAULT_SECONDS = 60.0


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_continued_run(parser, DEFAULT_SECONDS)
    parser.add_argument("takes", nargs="*", type=usable_path, metavar="CAPTURE", help="captures of the same head")
    parser.add_argument(
        "--growth",
        type=real_number,
        default=0.0,
        metavar="SHARE",
        help="splats to add, as a share of those on the triangles that the takes need",
    )


def run(options: Namespace) -> None:
    from ..training.run.continuation import prepare_extension
    from ..training.run.request import Extension

    if options.resume:
        resume_continuation(options)
        return
    if not options.takes:
        raise StgaError("CAPTURE: is missing; expected one or more takes to extend the run by")
    folder, device = continuation_folder(options)
    wanted = Extension(options.run_folder, tuple(options.takes), options.growth, **budget_of(options, DEFAULT_SECONDS))
    prepared = prepare_extension(wanted, device, options.flame)
    assert prepared.selection is not None
    share = np.any(list(prepared.selection.values()), axis=0).mean()
    print(f"takes: {1 + len(prepared.run.takes)}; the new ones need {share:.0%} of the triangles")
    train_run(folder, prepared.run, prepared.capture, prepared.selection, False, options.device == "auto")
