"""What `development` adds to the tables of commands and requests: `demo`, and `benchmark`, each
seed of which is a job of a batch (docs/commands.md): one after another on this machine, at once on
several."""

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..capture.open import open_capture
from ..cli.batch import EngineOptions, carry_out_plan, print_plan, with_threads
from ..cli.commands import COMMANDS, Command
from ..errors import StgaError
from ..jobs.batch.plan import make_plan
from ..jobs.table import JOBS, Job
from ..jobs.train import Train
from ..options import duration, given_options, like, option
from ..progress import Log, Report, Written
from ..training.settings import TrainingSettings
from ..worker.machine import processors
from .benchmark.variants import Benchmark

DEMO_ITERATIONS = 300
"""Iterations of the training, so that it is as good on a busy machine as on an idle one, where they
take about 15 seconds on two cores."""
SLICES = "benchmark"
"""First letters of the names of a benchmark's jobs and of their folders."""


@dataclass(frozen=True)
class DemoOptions:
    out: Path = option("folder of what is made", Path("out/demo"), metavar="DIR")
    seconds: float | None = like(TrainingSettings, "seconds", help="training time instead")
    iterations: int | None = like(
        TrainingSettings,
        "iterations",
        help=f"iterations of each training (default {DEMO_ITERATIONS})",
    )
    device: str = like(Train, "device")
    shot: bool = option("write shot.blend as well, a film scene around the avatar", False)
    footage: bool = option("make an avatar from the capture's images alone as well", False)
    phone: bool = option(
        "make an avatar from two videos of a phone as well: around a still head, and a talk", False
    )


def run_demo_command(options: Namespace, head: object) -> None:
    from ..raster.devices import choose_device
    from .demo.run import avatar_from_footage, avatar_from_phone, run_demo

    given = DemoOptions(**given_options(options, DemoOptions))
    device, why = choose_device(given.device)
    print(why)
    budget: dict[str, Any] = {"iterations": given.iterations or DEMO_ITERATIONS}
    if given.seconds is not None:
        budget = {"seconds": given.seconds}
    run_demo(given.out, budget, device=device, with_shot=given.shot)
    if given.footage:
        avatar_from_footage(given.out, budget, given.device)
    if given.phone:
        avatar_from_phone(given.out, budget, given.device)


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


def run_benchmark_command(options: Namespace, head: object) -> None:
    from .benchmark.benchmark import benchmark_jobs, slices_of, write_report

    given = BenchmarkOptions(**given_options(options, BenchmarkOptions))
    engine = EngineOptions(**given_options(options, EngineOptions))
    capture = open_capture(given.capture, given.flame, given.principal_point)
    for split, purpose in (("train", "train on"), ("val", "measure with")):
        if not capture.views.get(split):
            raise StgaError(f"{capture.root}: has no views to {purpose} (split '{split}')")
    flame = None if given.flame is None else given.flame.resolve()
    out = given.out.resolve()
    root = given.capture.resolve()
    request = Benchmark(
        out, root, given.seconds, flame, given.principal_point, knobs=given.knobs, only=given.only
    )
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


def train_benchmark(request: Benchmark, report: Report, log: Log) -> Written:
    from .benchmark.slice import train_slice  # needs more than numpy, which is enough for others

    return train_slice(request, report, log)


JOBS[Benchmark] = Job(train_benchmark, output="out")
COMMANDS["demo"] = Command(
    "Train an avatar on a capture of a generated person and show it in Blender.",
    run_demo_command,
    (DemoOptions,),
)
COMMANDS["benchmark"] = Command(
    "Compare accuracy and training time of strategies and presets on the CPU. "
    "Variants train in turns.",
    run_benchmark_command,
    (BenchmarkOptions, EngineOptions),
    uses_head=True,
)
