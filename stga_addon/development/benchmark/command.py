"""The command `benchmark`. Each seed is a job of a batch (docs/batch.md): one after another on this
machine, at once on several."""

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

from ...batch.plan import make_plan
from ...capture.open import open_capture
from ...cli.batch import EngineOptions, carry_out_plan, print_plan, with_threads
from ...cli.commands import Command
from ...errors import StgaError
from ...jobs.table import Benchmark
from ...jobs.train import Train
from ...options import duration, given_options, like, option
from ...worker.helpers import processors

SLICES = "benchmark"
"""How the names of the jobs, and of their folders, begin."""


@dataclass(frozen=True)
class BenchmarkOptions:
    capture: Path = like(Train, "capture")
    flame: Path | None = like(Train, "flame")
    principal_point: str = like(Train, "principal_point")
    seconds: float = option(
        "of each run (default 3m)", 180.0, flag="--budget", metavar="TIME", parse=duration
    )
    seeds: int = option("runs of each variant", 3, 1)
    knobs: bool = like(Benchmark, "knobs")
    only: tuple[str, ...] = option("one of the variants; may be repeated", (), metavar="VARIANT")
    out: Path = option("keeps the runs, to be continued", Path("out/benchmark"), metavar="DIR")


def run(options: Namespace, head: object) -> None:
    from .benchmark import benchmark_jobs, slices_of, write_report

    given = BenchmarkOptions(**given_options(options, BenchmarkOptions))
    engine = EngineOptions(**given_options(options, EngineOptions))
    capture = open_capture(given.capture, given.flame, given.principal_point)
    for split, purpose in (("train", "train on"), ("val", "measure with")):
        if not capture.views.get(split):
            raise StgaError(f"{capture.root}: has no views to {purpose} (split '{split}')")
    flame = None if given.flame is None else given.flame.resolve()
    out, root = given.out.resolve(), given.capture.resolve()
    request = Benchmark(
        out, root, given.seconds, flame, given.principal_point, knobs=given.knobs, only=given.only
    )  # fmt: skip
    values = {"out": str(out), "job": benchmark_jobs(SLICES, request, given.seeds)}
    plan = with_threads(make_plan(values, out, "stga benchmark"), engine.threads or processors())
    if engine.dry_run:
        print_plan(plan)
        return
    try:
        carry_out_plan(plan, engine.engine, engine.address)
    finally:
        report = write_report(slices_of(plan, SLICES), out)
    print(report)


COMMAND = Command(
    "Compare accuracy and training time of strategies and presets on the CPU. "
    "Variants train in turns.",
    run,
    (BenchmarkOptions, EngineOptions),
    uses_head=True,
)
