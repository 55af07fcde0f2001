"""Identity of a job: a digest of its request and of what it reads, which tells whether it has to be done again."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from ..errors import StgaError
from ..requests.values import Request
from ..schema import to_json
from ..training.run.folder import AVATAR, RUN, has_run
from ..training.run.identity import file_digest
from .job import Job, input_paths


def job_digest(job: Job, jobs: Mapping[str, Job], digests: Mapping[str, str]) -> str:
    """SHA-256 of a job. jobs, digests: by name, those of the jobs that it comes after among them.

    Inputs count by name, size and time of change; a run that no job of the batch makes, by the content of its run file
    and avatar; what another job makes, by that job's digest. Raises StgaError where an input cannot be read.
    """
    made = [jobs[name].folder for name in job.after]
    paths = [path for of_field in input_paths(job.request).values() for path in of_field]
    read = [path for path in paths if not any(path.is_relative_to(folder) for folder in made)]
    parts = {
        "request": to_json(job.request, {}, Request),
        "after": {name: digests[name] for name in job.after},
        "inputs": {str(path): _input_digest(path) for path in read},
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


@cache
def _input_digest(path: Path) -> str:
    """Digest of a file or a folder, read once by a process."""
    if has_run(path):
        return "".join(file_digest(path / name) for name in (RUN, AVATAR) if (path / name).exists())
    try:
        lines = sorted(_listed(str(path), "")) if path.is_dir() else [_line(path.name, path.stat())]
    except OSError as error:
        raise StgaError(f"{error.filename or path}: cannot be read ({error.strerror or error})") from error
    return hashlib.sha256("\n".join(lines).encode("utf-8", "surrogateescape")).hexdigest()


def _listed(folder: str, inside: str) -> Iterator[str]:
    """A line for each file in a folder and those below, hidden ones left out."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith("."):
                continue
            if entry.is_dir():
                yield from _listed(entry.path, f"{inside}{entry.name}/")
            else:
                yield _line(inside + entry.name, entry.stat())


def _line(name: str, found: os.stat_result) -> str:
    return f"{name} {found.st_size} {found.st_mtime_ns}"
