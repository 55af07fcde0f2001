"""Carrying out requests, in this process or as the worker of a folder, which holds

request.json   the request; request.npz: its arrays
result.json    what was found, where the request asks for something other than files; result.npz:
               its arrays
besides the files of the worker's status (`worker.status`).
"""

import os
from pathlib import Path
from typing import Any

from ..errors import StgaError, telling_refusals
from ..files import read_document, read_npz, write_document, write_npz
from ..options import refuse_useless
from ..progress import Cancelled, Log, Progress, Report, ignore
from ..schema import Arrays, from_json, to_json, validate
from ..worker.launch import prepare_status_folder
from ..worker.status import PICTURE, PREVIEW, remove_status_folder, status_writer
from .compile_ahead import begin_training
from .table import JOBS, TRAINS, Request, Result, request_hint

FORMAT = "stga-request"
VERSION = 1
REQUEST = "request.json"
RESULT = "result.json"
FILES = (REQUEST, "request.npz", RESULT, "result.npz", PREVIEW, PICTURE)


def request_folder(subject: Path) -> Path:
    """The folder of a request inside that of its run or capture, so that they move together."""
    return subject / "job"


def worker_arguments(folder: Path, threads: int | None = None, resume: bool = False) -> list[str]:
    """What a worker's interpreter runs after `-m` for the request in the folder."""
    limit = [] if threads is None else ["--threads", str(threads)]
    return ["stga_addon", "perform", str(folder.resolve()), *limit, *["--resume"] * resume]


def write_request(folder: Path, request: Request) -> None:
    """Prepare the folder for a worker. Raises StgaError while one works in it."""
    prepare_status_folder(folder)
    for stale in FILES:
        (folder / stale).unlink(missing_ok=True)
    _write(folder / REQUEST, request, request_hint())


def read_request(folder: Path) -> Request:
    """Raises StgaError where the folder holds no request, or a damaged one."""
    if not has_request(folder):
        raise StgaError(f"{folder}: holds no request ({REQUEST} is missing)")
    return _read(folder / REQUEST, request_hint())


def has_request(folder: Path) -> bool:
    return (folder / REQUEST).is_file()


def remove_request(folder: Path) -> None:
    """Remove the files of a request, if the folder holds one, and its worker's status. Raises
    StgaError while its worker is working."""
    if has_request(folder):
        remove_status_folder(folder, FILES)


def write_result(folder: Path, result: Result) -> None:
    """Raises StgaError on a full disk."""
    _write(folder / RESULT, result, Result)


def read_result(folder: Path) -> Result:
    """Raises StgaError where the folder holds no result, or a damaged one."""
    return _read(folder / RESULT, Result)


def _write(path: Path, value: Any, kinds: Any) -> None:
    arrays: Arrays = {}
    values = to_json(value, arrays, kinds)
    if arrays:
        write_npz(path.with_suffix(".npz"), arrays, compressed=True)
    write_document(path, FORMAT, VERSION, values)


def _read(path: Path, kinds: Any) -> Any:
    values = read_document(path, "request", FORMAT, VERSION)
    arrays_path = path.with_suffix(".npz")
    arrays = read_npz(arrays_path) if os.path.exists(arrays_path) else {}
    return from_json(kinds, values, path, arrays)


def perform(request: Request, report: Report = ignore, log: Log = print) -> Result:
    """Carry out a request; returns what it found.

    log: called with lines about what was decided and found. Raises what the work raises: StgaError
    for mistakes and damaged files; Cancelled where the report stopped work that has nothing to
    keep; KeyboardInterrupt after Ctrl-C.
    """
    refuse_useless(request)
    validate(request)
    with telling_refusals():
        return JOBS[type(request)].work(request, report, log)


def perform_in_folder(
    folder: Path, log: Log = print, also: Report = ignore, resume: bool = False
) -> Result | None:
    """Carry out the request in a folder, with its status, previews and result there; None where it
    was cancelled.

    also: reported to as well. resume: what the request's output folder holds is what this request
    began: a training is resumed, other work is done anew. Raises as `perform` does; the message is
    in the final status, too.
    """
    # before anything is written into a folder that may be of something else
    if not has_request(folder):
        raise StgaError(f"{folder}: holds no request")
    with status_writer(folder) as writer:

        def report(progress: Progress) -> bool:
            stop = writer.report(progress)
            return also(progress) or stop

        writer.report(Progress(stage="Starting"))
        try:
            request = read_request(folder)
            job = JOBS[type(request)]
            if job.kind in TRAINS:
                begin_training()
            left: Any = job.left(request) if resume else request
            result: Result = perform(left, report, log) if type(left) in JOBS else left
        except Cancelled:
            return None
        write_result(folder, result)
        return result
