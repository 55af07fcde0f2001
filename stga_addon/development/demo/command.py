"""Make a synthetic capture, train an avatar on it and show it in Blender."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from ...cli.arguments import duration, usable_path
from ...jobs.delegate import OpenHead

NAME, HELP = "demo", "make a synthetic capture, train an avatar on it and show it in Blender"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("--out", type=usable_path, default=Path("out/demo"))
    parser.add_argument("--budget", type=duration, default=40.0, metavar="TIME")


def run(options: Namespace) -> None:
    from .run import run_demo

    run_demo(options.out, options.budget)
