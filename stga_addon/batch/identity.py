"""Identity of a job: a digest of its request and of what it reads, which tells whether it has to be done again."""

import hashlib
import json
import os
from collections.abc import Iterator, Set
from pathlib import Path

from ..errors import StgaError
from ..requests.values import Request
from ..schema import to_json
from ..training.run.folder import AVATAR, RUN, has_run
from ..training.run.identity import file_digest
from .job import input_paths, output_field
from .plan import Plan


def job_digests(plan: Plan) -> dict[str, str]:
    """Name of each job -> SHA-256 of it.

    Inputs count by name, size and time of change; a run that no job of the batch makes, by the content of its run file
    and avatar; what another job makes, by that job's digest; what the batch writes into an input, not at all. Raises
    StgaError where an input cannot be read.
    """
    folders, written = {job.name: job.folder for job in plan.jobs}, _written(plan)
    found: dict[str, str] = {}
    inputs: dict[Path, str] = {}
    for job in plan.jobs:
        made = [folders[name] for name in job.after]
        paths = [path for of_field in input_paths(job.request).values() for path in of_field]
        read = [path for path in paths if not any(path.is_relative_to(folder) for folder in made)]
        inputs |= {path: _input_digest(path, written) for path in read if path not in inputs}
        parts = {
            "request": to_json(job.request, {}, Request),
            "after": {name: found[name] for name in job.after},
            "inputs": {str(path): inputs[path] for path in read},
        }
        found[job.name] = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return found


def _written(plan: Plan) -> Set[str]:
    """The batch's folder, and what its jobs write elsewhere, without symbolic links."""
    fields = ((job.request, output_field(type(job.request))) for job in plan.jobs)
    outputs = (getattr(request, name) for request, name in fields if name is not None)
    elsewhere = (path for path in outputs if isinstance(path, Path) and not path.is_relative_to(plan.out))
    return {os.path.realpath(path) for path in (plan.out, *elsewhere)}


def _input_digest(path: Path, written: Set[str]) -> str:
    """Digest of a file, or of a folder without what is `written`."""
    if has_run(path):
        return "".join(file_digest(path / name) for name in (RUN, AVATAR) if (path / name).exists())
    try:
        if path.is_dir():
            lines = sorted(_listed(os.path.realpath(path), "", written))
        else:
            lines = [_line(path.name, path.stat())]
    except OSError as error:
        raise StgaError(f"{error.filename or path}: cannot be read ({error.strerror or error})") from error
    return hashlib.sha256("\n".join(lines).encode("utf-8", "surrogateescape")).hexdigest()


def _listed(folder: str, inside: str, written: Set[str]) -> Iterator[str]:
    """A line for each file in a folder and those below, hidden and written ones left out."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(".") or entry.path in written:
                continue
            if entry.is_dir():
                yield from _listed(entry.path, f"{inside}{entry.name}/", written)
            else:
                yield _line(inside + entry.name, entry.stat())


def _line(name: str, found: os.stat_result) -> str:
    return f"{name} {found.st_size} {found.st_mtime_ns}"
