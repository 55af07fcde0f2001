"""Make a synthetic capture, train an avatar on it and show it in Blender."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from ...cli.arguments import duration, usable_path
from ...jobs.delegate import OpenHead

NAME, HELP = "demo", "make a synthetic capture, train an avatar on it and show it in Blender"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("--out", type=usable_path, default=Path("out/demo"))
    parser.add_argument("--budget", type=duration, default=40.0, metavar="TIME")
    parser.add_argument("--footage", action="store_true", help="make an avatar from the capture's images alone as well")


def run(options: Namespace) -> None:
    from .run import avatar_from_footage, run_demo

    run_demo(options.out, options.budget)
    if options.footage:
        avatar_from_footage(options.out, options.budget)
