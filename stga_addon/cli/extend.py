"""Extend a finished avatar by further takes of the same head, in a run of its own."""

from argparse import ArgumentParser, Namespace

from ..errors import StgaError
from ..requests.open_head import OpenHead
from ..requests.values import Extend, SelectForTake
from .arguments import real_number, usable_path
from .carry_out import carry_out, carry_out_selection
from .continuing import add_continued_run, continued_run, resumed_continuation

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
    parser.add_argument(
        "--select-only",
        type=usable_path,
        metavar="NPZ",
        help="only write which triangles it would train: timestep of the take -> triangles",
    )


def run(options: Namespace) -> None:
    if options.resume:
        carry_out(resumed_continuation(options))
        return
    if not options.takes:
        raise StgaError("CAPTURE: is missing; expected one or more takes to extend the run by")
    if options.select_only:
        _write_selection(options)
        return
    carry_out(Extend(captures=tuple(options.takes), **continued_run(options, DEFAULT_SECONDS)))


def _write_selection(options: Namespace) -> None:
    """Print and write which triangles of each frame of the take would be trained."""
    if len(options.takes) != 1:
        raise StgaError(f"--select-only: expected one CAPTURE, got {len(options.takes)}")
    carry_out_selection(SelectForTake(options.run_folder, options.takes[0], options.flame), options.select_only)
