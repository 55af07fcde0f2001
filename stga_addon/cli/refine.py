"""Train one region of a finished avatar further; every other splat stays as it is, and so does the run."""

from argparse import ArgumentParser, Namespace

from ..errors import StgaError
from ..requests.open_head import OpenHead
from .arguments import frame_span, real_number
from .continuing import add_continued_run, budget_of, continuation_folder, resume_continuation
from .train import train_run

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
    from ..training.run.continuation import prepare_refinement
    from ..training.run.request import Refinement

    if options.resume:
        resume_continuation(options)
        return
    if options.region is None:
        raise StgaError("--region: is missing; expected the name of a region or a file of triangle weights")
    folder, device = continuation_folder(options)
    wanted = Refinement(
        options.run_folder, options.region, options.frames, options.growth, **budget_of(options, DEFAULT_SECONDS)
    )
    prepared, falls_back = prepare_refinement(wanted, device, options.flame), options.device == "auto"
    train_run(folder, prepared.run, prepared.capture, prepared.selection, resume=False, falls_back=falls_back)
