"""Train one region of a finished avatar further; every other splat stays as it is, and so does the run."""

from argparse import ArgumentParser, Namespace

from ..errors import StgaError
from ..requests.open_head import OpenHead
from ..requests.values import Refine
from .arguments import frame_span, real_number
from .carry_out import carry_out
from .continuing import add_continued_run, continued_run, resumed_continuation

NAME, HELP = "refine", "train one region of a finished avatar further"
DEFAULT_SECONDS = 20.0


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_continued_run(parser, DEFAULT_SECONDS)
    parser.add_argument(
        "--region",
        metavar="NAME|FILE",
        help="region of the capture, vertex mask of FLAME, or file of triangle weights (docs/formats.md)",
    )
    parser.add_argument("--frames", type=frame_span, metavar="FIRST-LAST", help="timesteps to train on (default: all)")
    parser.add_argument(
        "--growth", type=real_number, default=0.0, metavar="SHARE", help="splats to add, as a share of the region's"
    )


def run(options: Namespace) -> None:
    if options.resume:
        carry_out(resumed_continuation(options))
        return
    if not options.region:
        raise StgaError("--region: is missing; expected the name of a region or a file of triangle weights")
    carry_out(Refine(region=options.region, frames=options.frames, **continued_run(options, DEFAULT_SECONDS)))
