"""Measure PSNR, SSIM and LPIPS of a run's avatar on a split; print them and write them into the run's folder."""

from argparse import ArgumentParser, Namespace

from ..requests.open_head import OpenHead
from ..requests.values import Evaluate
from .arguments import usable_path
from .carry_out import carry_out

NAME, HELP = "eval", "PSNR, SSIM and LPIPS on held-out views"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("run_folder", type=usable_path, metavar="RUN", help="folder of a run")
    parser.add_argument(
        "--split", choices=("train", "val", "test"), default="val", help="views to measure on (default val)"
    )
    # Under another name than "capture", which an open head would stand in for: the run must find its own.
    parser.add_argument("--capture", dest="moved_capture", type=usable_path, help="the run's capture, if it has moved")
    parser.add_argument("--flame", type=usable_path, metavar="FILE", help="FLAME model file, if it has moved")


def run(options: Namespace) -> None:
    carry_out(Evaluate(options.run_folder, options.split, options.flame, options.moved_capture), with_bar=False)
