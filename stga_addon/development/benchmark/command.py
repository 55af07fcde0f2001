"""Train variants for the same time in turns, and print how they compare."""

import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from ...cli.arguments import add_capture, duration, usable_path, whole_number
from ...cli.inputs import open_named_capture, principal_point_of
from ...errors import StgaError
from ...requests.open_head import OpenHead
from ...requests.values import Train
from ...training.settings import make_settings
from .variants import MAIN_VARIANTS, SETTING_VARIANTS, select_variants

NAME, HELP = "benchmark", "compare accuracy and training time of strategies and presets on the CPU"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    parser.add_argument("--budget", type=duration, default=180.0, metavar="TIME", help="of each run (default 3m)")
    parser.add_argument("--seeds", type=whole_number(1), default=3, help="runs of each variant (default 3)")
    parser.add_argument("--knobs", action="store_true", help="compare single settings instead")
    parser.add_argument("--only", nargs="+", metavar="VARIANT", help="some of the variants")
    parser.add_argument(
        "--out", type=usable_path, default=Path("out/benchmark"), metavar="DIR", help="keeps the runs, to be continued"
    )


def run(options: Namespace) -> None:
    from .benchmark import run_benchmark

    variants = select_variants(SETTING_VARIANTS if options.knobs else MAIN_VARIANTS, options.only)
    settings = make_settings(seconds=options.budget)
    capture = open_named_capture(options)
    for split, purpose in (("train", "train on"), ("val", "measure with")):
        if not capture.views.get(split):
            raise StgaError(f"{capture.root}: has no views to {purpose} (split '{split}')")
    flame = None if options.flame is None else options.flame.resolve()
    out, root, point = options.out.resolve(), options.capture.resolve(), principal_point_of(options)
    request = Train(out, root, settings, flame, point, device="cpu")
    print(run_benchmark(request, variants, options.budget, options.seeds, _print_progress))


def _print_progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
