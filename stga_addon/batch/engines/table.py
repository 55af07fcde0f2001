"""The engines, and the farms' formats, that there are: a row and a file each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ...files import replacing, write_json
from ..engine import Engine
from ..folder import prepare
from ..job import Job
from ..plan import Plan
from ..run import Batch


@dataclass(frozen=True)
class EngineRow:
    """module and name: of the function that makes an engine from an address, or a farm's file; what: for the help."""

    module: str
    name: str
    what: str


ENGINES = {
    "local": EngineRow(".local", "make_local", "this machine, as many jobs at once as its processors and memory allow"),
    "ray": EngineRow(".ray", "make_ray", "a Ray cluster at --address, or one started here"),
    "slurm": EngineRow(".slurm", "make_slurm", "a SLURM cluster, as arrays of sbatch"),
}
"""Name on the command line -> engine."""

EMITTERS = {
    "openjd": EngineRow(".openjd", "openjd_template", "batch.openjd.json, a template of Open Job Description"),
    "flamenco": EngineRow(".flamenco", "flamenco_job_type", "stga_batch.js, a job type of Flamenco"),
}
"""Name on the command line -> function that makes a farm's file from the plan and its unfinished jobs."""
FILES = {"openjd": "batch.openjd.json", "flamenco": "stga_batch.js"}


def emit(name: str, batch: Batch) -> Path:
    """Prepare the folders of a batch's unfinished jobs, and write the file by which a farm carries them out; returns
    its path. Raises StgaError where a worker is running in a folder, or the farm's format cannot hold the batch."""
    row, jobs = EMITTERS[name], batch.unfinished
    make: Callable[[Plan, Sequence[Job]], Any] = getattr(import_module(row.module, __package__), row.name)
    made = make(batch.plan, jobs)
    for job in jobs:
        entry = batch.entries[job.name]
        prepare(job, entry.digest, entry.forecast_s)
    path = batch.plan.out / FILES[name]
    if not isinstance(made, str):
        write_json(path, made)
        return path
    with replacing(path) as partial:
        partial.write_text(made, encoding="utf-8")
    return path


def make_engine(name: str, address: str = "") -> Engine:
    """Raises StgaError where the engine is not there, or has no use for an address."""
    row = ENGINES[name]
    make: Callable[[str], Engine] = getattr(import_module(row.module, __package__), row.name)
    return make(address)
