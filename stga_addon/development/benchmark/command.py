"""Train variants for the same time in turns, and print how they compare.

Each seed is a job of a batch (docs/batch.md): one after another on this machine, at once on several.
"""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from ...batch.plan import make_plan
from ...cli.arguments import add_capture, duration, usable_path, whole_number
from ...cli.batch import add_engine, carry_out_plan, print_plan, with_threads
from ...cli.inputs import open_named_capture, principal_point_of
from ...errors import StgaError
from ...requests.open_head import OpenHead
from ...requests.values import Benchmark
from ...worker.helpers import processors

NAME, HELP = "benchmark", "compare accuracy and training time of strategies and presets on the CPU"
SLICES = "benchmark"
"""How the names of the jobs, and of their folders, begin."""


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    parser.add_argument("--budget", type=duration, default=180.0, metavar="TIME", help="of each run (default 3m)")
    parser.add_argument("--seeds", type=whole_number(1), default=3, help="runs of each variant (default 3)")
    parser.add_argument("--knobs", action="store_true", help="compare single settings instead")
    parser.add_argument("--only", nargs="+", metavar="VARIANT", help="some of the variants")
    parser.add_argument(
        "--out", type=usable_path, default=Path("out/benchmark"), metavar="DIR", help="keeps the runs, to be continued"
    )
    add_engine(parser)


def run(options: Namespace) -> None:
    from .benchmark import benchmark_jobs, slices_of, write_report

    capture = open_named_capture(options)
    for split, purpose in (("train", "train on"), ("val", "measure with")):
        if not capture.views.get(split):
            raise StgaError(f"{capture.root}: has no views to {purpose} (split '{split}')")
    flame = None if options.flame is None else options.flame.resolve()
    out, root, only = options.out.resolve(), options.capture.resolve(), tuple(options.only or ())
    request = Benchmark(out, root, options.budget, flame, principal_point_of(options), knobs=options.knobs, only=only)
    values = {"out": str(out), "job": benchmark_jobs(SLICES, request, options.seeds)}
    plan = with_threads(make_plan(values, out, "stga benchmark"), options.threads or processors())
    if options.dry_run:
        print_plan(plan)
        return
    try:
        carry_out_plan(plan, options.engine, options.address)
    finally:
        report = write_report(slices_of(plan, SLICES), out)
    print(report)
