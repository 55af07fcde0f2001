"""Folders of a batch, which one process holds, and of a job: what it holds from earlier starts, how
it is prepared, and the digest that shows whether it has to be done again.

job.json   beside the request: the job's identity, and how long it took
"""

import hashlib
import json
import os
from collections.abc import Iterator, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from filelock import SoftFileLease

from ...errors import StgaError
from ...files import file_digest, naming, read_document, write_document
from ...schema import from_json, setting, to_json
from ...training.run.folder import AVATAR, RUN, has_run
from ...worker.launch import prepare_status_folder
from ...worker.lock import hold_folder, is_locked
from ...worker.status import LOCK_FILE, WorkerState, read_status
from ..perform import has_request, write_request
from ..table import JOBS, request_hint
from .plan import REPLACED, Job, Plan, input_paths


def job_digests(plan: Plan) -> dict[str, str]:
    """Name of each job -> SHA-256 of all that its result depends on.

    That is the request, with the paths in it, and its inputs: files by path, size and time of
    change; a run that no job of the batch makes by the content of its run file and avatar; what
    another job makes by that job's digest. What the batch itself writes into an input does not
    count. Raises StgaError where an input cannot be read.
    """
    folders = {job.name: job.folder for job in plan.jobs}
    fields = ((job.request, JOBS[type(job.request)].output) for job in plan.jobs)
    outputs = (getattr(request, name) for request, name in fields if name)
    written = {os.path.realpath(path) for path in (plan.out, *outputs) if isinstance(path, Path)}
    found: dict[str, str] = {}
    inputs: dict[Path, str] = {}
    for job in plan.jobs:
        made = [folders[name] for name in job.after]
        paths = [path for of_field in input_paths(job.request).values() for path in of_field]
        read = [path for path in paths if not any(path.is_relative_to(folder) for folder in made)]
        inputs |= {path: _input_digest(path, written) for path in read if path not in inputs}
        parts = {
            "request": to_json(job.request, {}, request_hint()),
            "after": {name: found[name] for name in job.after},
            "inputs": {str(path): inputs[path] for path in read},
        }
        found[job.name] = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return found


def _input_digest(path: Path, written: Set[str]) -> str:
    """Digest of a file, or of a folder without what is `written` (paths without links)."""
    if has_run(path):
        return "".join(file_digest(path / name) for name in (RUN, AVATAR) if (path / name).exists())
    try:
        if path.is_dir():
            lines = sorted(_listed(os.path.realpath(path), "", written))
        else:
            lines = [_line(path.name, path.stat())]
    except OSError as error:
        raise StgaError(
            f"{error.filename or path}: cannot be read ({error.strerror or error})"
        ) from error
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


LOCK = "batch.lock"
JOB_FILE = "job.json"
FORMAT = "stga-job"
VERSION = 1


@contextmanager
def hold_batch(folder: Path) -> Iterator[SoftFileLease]:
    """Hold a batch's folder, which is made, on whichever machine. Raises StgaError while another
    batch works in it."""
    with hold_folder(folder, LOCK, "batch is working in this folder", leased=True) as lease:
        assert lease is not None
        yield lease


@dataclass(frozen=True)
class JobRecord:
    """Content of job.json.

    digest    of `job_digests`
    seconds   that all its workers worked
    machine   that carried it out last
    """

    digest: str
    seconds: float = setting(0.0, 0)
    machine: str = ""


def write_record(job: Job, record: JobRecord) -> None:
    """Raises StgaError on a full disk."""
    write_document(job.request_folder / JOB_FILE, FORMAT, VERSION, to_json(record))


def read_record(job: Job) -> JobRecord | None:
    """None where the job was never prepared, or by another version."""
    with suppress(StgaError):
        path = job.request_folder / JOB_FILE
        values = read_document(path, "job", FORMAT, VERSION)
        values.pop("forecast_s", None)  # of batches begun by an earlier version
        return from_json(JobRecord, values)
    return None


def _is_record_of(job: Job, digest: str) -> bool:
    record = read_record(job)
    return record is not None and record.digest == digest


def is_done(job: Job, digest: str) -> bool:
    """Whether a worker has finished this very job, and what it wrote is there."""
    status = read_status(job.request_folder) if _is_record_of(job, digest) else None
    return status is not None and status.state == WorkerState.FINISHED and job.is_written


def is_running(job: Job, digest: str) -> bool:
    """Whether a worker of an earlier start is carrying out this very job."""
    return _is_record_of(job, digest) and is_locked(job.request_folder / LOCK_FILE)


def prepare(job: Job, digest: str) -> Path | None:
    """Make the job's folder ready for a worker, which continues what an earlier one began; returns
    where another request's files were moved. Raises StgaError for a running worker, and files of
    others."""
    record = read_record(job)
    moved = None
    if record is not None and record.digest != digest:
        prepare_status_folder(job.request_folder)  # raises while a worker is running
        kept = job.folder.parent / REPLACED
        name = job.folder.name
        names = (name if n == 1 else f"{name}_{n}" for n in count(1))
        moved = next(kept / name for name in names if not (kept / name).exists())
        record = None
        with naming(job.folder, f"moved to {moved}"):
            kept.mkdir(exist_ok=True)
            job.folder.rename(moved)
    if record is None:
        held = job.folder.iterdir() if job.folder.is_dir() else ()
        if any(path.name != job.request_folder.name for path in held):
            raise StgaError(
                f"{job.folder}: holds files that no job of a batch wrote; choose another 'out'"
            )
        write_record(job, JobRecord(digest))
    if record is None or not has_request(job.request_folder):
        write_request(job.request_folder, job.request)
    else:
        prepare_status_folder(job.request_folder)
    return moved
