"""Make a synthetic capture, train an avatar on it and show it in Blender."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from ...cli.arguments import add_device, duration, usable_path, whole_number
from ...requests.open_head import OpenHead

NAME, HELP = "demo", "make a synthetic capture, train an avatar on it and show it in Blender"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("--out", type=usable_path, default=Path("out/demo"))
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--budget", type=duration, default=40.0, metavar="TIME")
    budget.add_argument(
        "--iterations", type=whole_number(1), help="number of iterations instead, of the first training"
    )
    add_device(parser)
    parser.add_argument("--footage", action="store_true", help="make an avatar from the capture's images alone as well")


def run(options: Namespace) -> None:
    from ...render.device import choose_device
    from .run import avatar_from_footage, run_demo

    device, why = choose_device(options.device)
    print(why)
    budget = {"seconds": options.budget} if options.iterations is None else {"iterations": options.iterations}
    run_demo(options.out, budget, device=device)
    if options.footage:
        avatar_from_footage(options.out, options.budget, options.device)
