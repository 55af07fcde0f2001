"""Find out the light of a run's capture, so that the lights of a scene can take its place."""

from argparse import ArgumentParser, Namespace

from ..requests.open_head import OpenHead
from ..requests.values import Relight
from .arguments import color, usable_path
from .carry_out import carry_out

NAME, HELP = "relight", "estimate the light of a run's capture, so that scenes can light its avatar"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("run_folder", type=usable_path, metavar="RUN", help="folder of a run")
    parser.add_argument(
        "--light", type=usable_path, metavar="FILE.hdr", help="environment of the studio, instead of an estimate"
    )
    parser.add_argument(
        "--gray-card", type=color, metavar="R,G,B",
        help="sRGB in 0…1 of an 18 %% gray card at the face that faces the central camera: level and white balance",
    )  # fmt: skip
    # Under another name than "capture", which an open head would stand in for: the run must find its own.
    parser.add_argument("--capture", dest="moved_capture", type=usable_path, help="the run's capture, if it has moved")
    parser.add_argument("--flame", type=usable_path, metavar="FILE", help="FLAME model file, if it has moved")


def run(options: Namespace) -> None:
    carry_out(Relight(options.run_folder, options.light, options.gray_card, options.flame, options.moved_capture))
