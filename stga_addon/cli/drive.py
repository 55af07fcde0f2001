"""Convert between motions of FLAME heads and performances in ARKit's 52 blend shapes."""

from argparse import ArgumentParser, Namespace

from ..requests.open_head import OpenHead
from ..requests.values import ConvertMotion
from .arguments import frame_rate, usable_path
from .carry_out import carry_out
from .motion import add_motion_options, motion_options

NAME, HELP = "drive", "convert a face performance (ARKit's 52 shapes) to a FLAME motion, or a motion to a CSV of shapes"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument(
        "source",
        type=usable_path,
        metavar="MOTION",
        help="a performance (CSV, JSON, text, take folder), a video of a face, FLAME parameters (.npz), or a capture "
        "tracked with FLAME",
    )
    parser.add_argument(
        "--out",
        type=usable_path,
        required=True,
        metavar="FILE",
        help="ARKit's shapes (.csv) or FLAME parameters (.npz)",
    )
    parser.add_argument("--flame", type=usable_path, help="FLAME model file of the head (default: the bundled head)")
    parser.add_argument(
        "--head", type=usable_path, metavar="CAPTURE", dest="of", help="whose identity (default: average)"
    )
    parser.add_argument("--fps", type=frame_rate, help="frames per second of the result (default: as recorded)")
    add_motion_options(parser)


def run(options: Namespace) -> None:
    chosen = motion_options(options)
    carry_out(ConvertMotion(options.source, options.out, options.flame, options.of, options.fps, chosen))
