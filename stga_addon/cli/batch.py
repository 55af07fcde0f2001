"""The command `batch`: carrying out a plan of many jobs, or training many captures."""

import shlex
import shutil
import sys
from argparse import Namespace
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..jobs.batch.engines import ENGINES
from ..jobs.batch.plan import Plan, plan_of_captures, read_plan
from ..jobs.train import Train
from ..options import When, given_options, like, option
from ..training.settings import TrainingSettings
from ..worker.launch import PACKAGES_FOLDER
from ..worker.machine import processors

PLAN_SUFFIX = ".toml"


CAPTURES = When(
    lambda value: value.sources[0].suffix != PLAN_SUFFIX, "with a plan, which says that itself"
)
HERE = When(
    lambda value: not getattr(value, "commands", None), "with --commands, which carries out nothing"
)


@dataclass(frozen=True)
class BatchOptions:
    """A plan, or captures with what a plan has in its file."""

    sources: tuple[Path, ...] = option(
        "a plan (docs/commands.md#batches), or captures", flag="PLAN.toml|CAPTURE"
    )
    out: Path | None = option(
        "folder of the batch; required with captures", None, metavar="RUNS", needs=(CAPTURES,)
    )
    preset: str | None = like(
        TrainingSettings,
        "preset",
        help="quality of each capture; it, --budget or --iterations is required with captures",
        needs=(CAPTURES,),
    )
    seconds: float | None = like(
        TrainingSettings, "seconds", help="training time of each capture", needs=(CAPTURES,)
    )
    iterations: int | None = like(TrainingSettings, "iterations", needs=(CAPTURES,))
    seed: int = like(TrainingSettings, "seed", needs=(CAPTURES,))
    flame: Path | None = like(Train, "flame", needs=(CAPTURES,))
    principal_point: str = like(Train, "principal_point", needs=(CAPTURES,))
    device: str = like(Train, "device", needs=(CAPTURES,))
    commands: bool = option(
        "prepare the jobs and print a command for each, for another scheduler",
        False,
        needs=(When(lambda value: not value.dry_run, "with --dry-run, which prepares nothing"),),
    )


@dataclass(frozen=True)
class EngineOptions:
    """How the jobs of a plan are carried out."""

    threads: int | None = option("threads of each job that names none", None, 1, metavar="N")
    dry_run: bool = option("print the jobs, and how long they are expected to take", False)
    engine: str = option(
        "; ".join(f"{name}: {what}" for name, (what, _) in ENGINES.items()),
        "local",
        choices=ENGINES,
        needs=(HERE,),
    )
    address: str = option(
        "of a running cluster (ray)",
        "",
        needs=(When(lambda value: value.engine == "ray", "without --engine ray"),),
    )


def run_batch_command(options: Namespace, head: object = None) -> None:
    chosen = EngineOptions(**given_options(options, EngineOptions))
    plan = batch_plan(options)
    is_here = chosen.engine == "local" and not options.commands
    fraction = max(1, processors() // len(plan.jobs)) if is_here else 1
    plan = with_threads(plan, chosen.threads or fraction)
    if chosen.dry_run:
        print_plan(plan)
    elif options.commands:
        from ..jobs.batch.folder import hold_batch, prepare
        from ..jobs.batch.plan import job_command
        from ..jobs.batch.run import Batch

        with hold_batch(plan.out):
            batch = Batch(plan)
            for job in batch.unfinished:
                prepare(job, batch.entries[job.name].digest)
                command = ["env", f"PYTHONPATH={PACKAGES_FOLDER}", *job_command(job)]
                waits = [name for name in job.after if not batch.entries[name].state.is_over]
                print(shlex.join(command) + (f"  # after {' '.join(waits)}" if waits else ""))
    else:
        carry_out_plan(plan, chosen.engine, chosen.address)


def batch_plan(options: Namespace) -> Plan:
    """Raises StgaError for a mistake in the plan."""
    given = given_options(options, BatchOptions)
    sources = given.pop("sources")
    given.pop("commands", None)
    if sources[0].suffix == PLAN_SUFFIX:
        if len(sources) > 1:
            raise StgaError(f"{sources[1]}: cannot be given beside a plan")
        return read_plan(sources[0])
    out = given.pop("out", None)
    if out is None:
        raise StgaError("--out: is missing; expected the folder of the batch")
    missing = next((path for path in sources if not path.is_dir()), None)
    if missing is not None:
        raise StgaError(
            f"{missing}: is not a folder; expected that of a capture, or a plan that ends in "
            f"{PLAN_SUFFIX}"
        )
    named = ("preset", "seconds", "iterations", "seed")
    settings: dict[str, Any] = {name: given.pop(name) for name in named if name in given}
    if not {"preset", "seconds", "iterations"} & settings.keys():
        raise StgaError("--preset: is missing; expected it, --budget or --iterations")
    if "flame" in given:
        given["flame"] = str(given["flame"].absolute())
    return plan_of_captures(sources, out, settings, given)


def with_threads(plan: Plan, threads: int) -> Plan:
    """The plan with so many threads for the jobs that name none."""
    jobs = []
    for job in plan.jobs:
        resources = replace(job.resources, threads=job.resources.threads or threads)
        jobs.append(replace(job, resources=resources))
    return replace(plan, jobs=tuple(jobs))


def print_plan(plan: Plan) -> None:
    """Print the jobs, and how long they are expected to take."""
    from ..jobs.batch.run import Batch
    from ..jobs.batch.table import plan_lines

    print("\n".join(plan_lines(Batch(plan), processors())))


def carry_out_plan(plan: Plan, engine_name: str, address: str) -> None:
    """Carry out what is not finished, with a table. Raises StgaError where a job failed,
    KeyboardInterrupt after Ctrl-C when the running jobs have stopped."""
    from ..jobs.batch.engines import make_engine
    from ..jobs.batch.folder import hold_batch
    from ..jobs.batch.run import Batch, BatchRun
    from ..jobs.batch.table import LiveTable, ended_lines

    with hold_batch(plan.out) as lease:
        batch = Batch(plan)
        engine = make_engine(engine_name, address)
        table = LiveTable(sys.stderr, shutil.get_terminal_size().columns)
        try:
            BatchRun(batch, engine, lease, table, table.log).run()
        finally:
            print("\n".join(ended_lines(batch)))
    failures = batch.failures
    if failures:
        raise StgaError(
            f"{len(failures)} of {len(plan.jobs)} jobs failed; {failures[0].job.name}: "
            f"{failures[0].error}"
        )
