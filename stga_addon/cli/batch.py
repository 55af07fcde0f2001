"""Carry out a plan of many jobs, or train many captures: on this machine, or on the engine that is there."""

import shlex
import shutil
import sys
from argparse import ArgumentParser, Namespace
from dataclasses import replace

from ..batch.engines.table import ENGINES
from ..batch.plan import Plan, plan_of_captures, read_plan
from ..errors import StgaError
from ..requests.open_head import OpenHead
from ..training.settings import PRESETS
from ..worker.launch import PACKAGES_FOLDER
from .arguments import add_device, add_principal_point, duration, usable_path, whole_number
from .inputs import principal_point_of

NAME, HELP = "batch", "carry out a plan of many jobs, or train many captures"
PLAN_SUFFIX = ".toml"
OF_CAPTURES = ("out", "preset", "budget", "iterations", "seed", "flame", "principal_point")
"""Options that a plan has in its file."""


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument(
        "sources", type=usable_path, nargs="+", metavar="PLAN.toml|CAPTURE", help="a plan (docs/batch.md), or captures"
    )
    parser.add_argument("--out", type=usable_path, metavar="RUNS", help="folder of the batch, where captures are given")
    parser.add_argument("--preset", choices=tuple(PRESETS), help="quality and training time of captures")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--budget", type=duration, metavar="TIME", help="training time of each capture")
    budget.add_argument("--iterations", type=whole_number(1), help="number of iterations of each capture")
    parser.add_argument("--seed", type=whole_number(0), help="fixes every random choice (default 0)")
    parser.add_argument("--flame", type=usable_path, metavar="FILE", help="FLAME model file of the captures")
    add_principal_point(parser)
    add_device(parser)
    add_engine(parser)
    parser.add_argument(
        "--commands", action="store_true", help="prepare the jobs and print a command for each, for another scheduler"
    )


def add_engine(parser: ArgumentParser) -> None:
    """Options of how the jobs of a plan are carried out."""
    parser.add_argument("--threads", type=whole_number(1), metavar="N", help="threads of each job that names none")
    parser.add_argument("--dry-run", action="store_true", help="print the jobs, and how long they are expected to take")
    engines = "; ".join(f"{name}: {what}" for name, (_, what) in ENGINES.items())
    parser.add_argument("--engine", choices=tuple(ENGINES), default="local", help=f"{engines} (default local)")
    parser.add_argument("--address", default="", help="of a running cluster (ray)")


def run(options: Namespace) -> None:
    plan = batch_plan(options)
    plan = with_threads(plan, options.threads or _shared_threads(plan, options))
    if options.dry_run:
        print_plan(plan)
    elif options.commands:
        _print_commands(plan)
    else:
        carry_out_plan(plan, options.engine, options.address)


def batch_plan(options: Namespace) -> Plan:
    """Raises StgaError for a mistake in the plan, and for options that would have no effect with one."""
    if options.sources[0].suffix != PLAN_SUFFIX:
        return _plan_of_captures(options)
    if len(options.sources) > 1:
        raise StgaError(f"{options.sources[1]}: cannot be given beside a plan")
    changed = [name for name in OF_CAPTURES if getattr(options, name) is not None]
    changed += ["device"] if options.device != "auto" else []
    if changed:
        raise StgaError(f"--{changed[0].replace('_', '-')}: has no effect with a plan, which says that itself")
    return read_plan(options.sources[0])


def _plan_of_captures(options: Namespace) -> Plan:
    if options.out is None:
        raise StgaError("--out: is missing; expected the folder of the batch")
    missing = next((path for path in options.sources if not path.is_dir()), None)
    if missing is not None:
        raise StgaError(f"{missing}: is not a folder; expected that of a capture, or a plan that ends in {PLAN_SUFFIX}")
    chosen = {
        "preset": options.preset,
        "seconds": options.budget,
        "iterations": options.iterations,
        "seed": options.seed,
    }
    settings = {name: value for name, value in chosen.items() if value is not None}
    if not {"preset", "seconds", "iterations"} & settings.keys():
        raise StgaError("--preset: is missing; expected it, --budget or --iterations")
    fields = {"device": options.device, "principal_point": principal_point_of(options)}
    if options.flame is not None:
        fields["flame"] = str(options.flame.absolute())
    return plan_of_captures(options.sources, options.out, settings, fields)


def _shared_threads(plan: Plan, options: Namespace) -> int:
    """This machine's processors, shared among the jobs; 1 on every other engine."""
    from ..worker.helpers import processors

    is_here = options.engine == "local" and not options.commands
    return max(1, processors() // len(plan.jobs)) if is_here else 1


def with_threads(plan: Plan, threads: int) -> Plan:
    """The plan with so many threads for the jobs that name none."""
    jobs = [
        job if job.resources.threads else replace(job, resources=replace(job.resources, threads=threads))
        for job in plan.jobs
    ]
    return replace(plan, jobs=tuple(jobs))


def print_plan(plan: Plan) -> None:
    """Print the jobs, and how long they are expected to take."""
    from ..batch.forecast import forecast_seconds
    from ..batch.report import plan_lines
    from ..batch.run import Batch
    from ..worker.helpers import processors

    batch = Batch(plan)
    batch.set_forecasts(forecast_seconds(batch.unfinished, batch.finished))
    print("\n".join(plan_lines(batch, processors())))


def _print_commands(plan: Plan) -> None:
    """Prepare the folders of the jobs that are not finished, and print a shell command for each in an order in which
    they can be done. Raises StgaError where a worker is running in a folder."""
    from ..batch.folder import hold_folder, prepare
    from ..batch.job import job_command
    from ..batch.run import Batch

    with hold_folder(plan.out):
        batch = Batch(plan)
        for job in batch.unfinished:
            prepare(job, batch.entries[job.name].digest, 0.0)
            command = ["env", f"PYTHONPATH={PACKAGES_FOLDER}", *job_command(job)]
            waits = [name for name in job.after if not batch.entries[name].state.is_over]
            print(shlex.join(command) + (f"  # after {' '.join(waits)}" if waits else ""))


def carry_out_plan(plan: Plan, engine_name: str = "local", address: str = "") -> None:
    """Carry out what is not finished, with the live table and the report.

    Raises StgaError where a job failed, KeyboardInterrupt after Ctrl-C when the running jobs have stopped.
    """
    from ..batch.engines.table import make_engine
    from ..batch.folder import hold_folder
    from ..batch.forecast import forecast_seconds
    from ..batch.report import LiveTable, summary_line, write_report
    from ..batch.run import Batch, run_batch

    with hold_folder(plan.out) as lease:
        batch = Batch(plan)
        engine = make_engine(engine_name, address)
        batch.set_forecasts(forecast_seconds(batch.unfinished, batch.finished))
        table = LiveTable(sys.stderr, shutil.get_terminal_size().columns)
        try:
            run_batch(batch, engine, lease, table, table.say)
        finally:
            path = write_report(batch)
            print(f"{summary_line(batch)}\nreport: {path}")
    failures = batch.failures
    if failures:
        first = failures[0]
        raise StgaError(f"{len(failures)} of {len(plan.jobs)} jobs failed; {first.job.name}: {first.error}")
