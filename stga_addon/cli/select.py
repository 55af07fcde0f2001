"""Show which triangles each frame selects for training."""

from argparse import ArgumentParser, Namespace

from ..requests.open_head import OpenHead
from ..requests.values import Select
from ..selection import SelectionOptions
from .arguments import add_capture, real_number, usable_path
from .carry_out import carry_out_selection
from .inputs import principal_point_of

NAME, HELP = "select", "show which triangles each frame selects for training"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    parser.add_argument(
        "--threshold",
        type=real_number,
        default=SelectionOptions.threshold,
        metavar="METERS",
        help=f"movement from which a triangle is selected (default {SelectionOptions.threshold:g})",
    )
    parser.add_argument(
        "--zero-pose",
        choices=("head", "all"),
        help="FLAME motion that does not count: the head's (default), or the jaw's and the eyes' as well",
    )
    parser.add_argument("--out", type=usable_path, metavar="NPZ", help="also write timestep -> triangles")


def run(options: Namespace) -> None:
    point = principal_point_of(options)
    request = Select(options.capture, options.flame, point, options.threshold, options.zero_pose)
    carry_out_selection(request, options.out)
