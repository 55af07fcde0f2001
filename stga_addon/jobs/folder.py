"""Folder of a request: the request, the files of the worker that carries it out, and what it found.

request.json   the request
request.npz    its arrays
result.json    what was found, where the request asks for something other than files; result.npz:
               its arrays
preview.npz    of a training: the avatar of a few seconds ago
picture.npz    of a tracking: the head over the footage, `rgb` (H, W, 3) uint8
besides the files of the worker's status (`worker.status`)
"""

import os
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import read_json, read_npz, write_json, write_npz
from ..render.video import check_output
from ..schema import Arrays, from_json, to_json
from ..tracking.folder import is_written
from ..training.run.folder import has_run, read_run
from ..worker.launch import prepare_status_folder
from ..worker.status import remove_status_folder
from .blender import RenderRecording
from .results import Result
from .table import Request
from .track import MakeAvatar, SolveAgain, Track, check_inputs
from .train import Extend, Refine, Resume, Train

FORMAT, VERSION = "stga-request", 1
REQUEST, REQUEST_ARRAYS = "request.json", "request.npz"
RESULT, RESULT_ARRAYS = "result.json", "result.npz"
PREVIEW, PICTURE = "preview.npz", "picture.npz"
FILES = (REQUEST, REQUEST_ARRAYS, RESULT, RESULT_ARRAYS, PREVIEW, PICTURE)


def request_folder(subject: Path) -> Path:
    """The folder of a request inside that of its run or capture, so that they move together."""
    return subject / "job"


def check_request(request: Request) -> None:
    """Raise StgaError for what can be known to fail before a worker is started."""
    match request:
        case Train() | Refine() | Extend() if has_run(request.run):
            problem = "already holds a run; resume it, or choose another folder"
            raise StgaError(f"{request.run}: {problem}")
        case Resume():
            read_run(request.run)
        case Track() if is_written(request.out):
            raise StgaError(f"{request.out}: already holds a capture; choose another folder")
        case MakeAvatar():
            check_inputs(request.track)
        case SolveAgain() if not is_written(request.capture):
            raise StgaError(f"{request.capture}: holds no tracked capture to solve again")
        case RenderRecording():
            check_output(request.output)


def worker_arguments(folder: Path, threads: int | None = None, resume: bool = False) -> list[str]:
    """What a worker's interpreter runs after `-m` for the request in the folder."""
    limit = [] if threads is None else ["--threads", str(threads)]
    return ["stga_addon", "perform", str(folder.resolve()), *limit, *["--resume"] * resume]


def write_request(folder: Path, request: Request) -> None:
    """Prepare the folder for a worker. Raises StgaError while one works in it."""
    prepare_status_folder(folder)
    for stale in FILES:
        (folder / stale).unlink(missing_ok=True)
    _write(folder / REQUEST, folder / REQUEST_ARRAYS, request, Request)


def read_request(folder: Path) -> Request:
    """Raises StgaError where the folder holds no request, or a damaged one."""
    if not (folder / REQUEST).is_file():
        raise StgaError(f"{folder}: holds no request ({REQUEST} is missing)")
    request: Request = _read(folder / REQUEST, folder / REQUEST_ARRAYS, Request)
    return request


def has_request(folder: Path) -> bool:
    return (folder / REQUEST).is_file()


def remove_request(folder: Path) -> None:
    """Remove the files of a request, if the folder holds one, and its worker's status. Raises
    StgaError while its worker is working."""
    if has_request(folder):
        remove_status_folder(folder, FILES)


def write_result(folder: Path, result: Result) -> None:
    """Raises StgaError on a full disk."""
    _write(folder / RESULT, folder / RESULT_ARRAYS, result, Result)


def read_result(folder: Path) -> Result:
    """Raises StgaError where the folder holds no result, or a damaged one."""
    result: Result = _read(folder / RESULT, folder / RESULT_ARRAYS, Result)
    return result


def _write(path: Path, arrays_path: Path, value: Any, kinds: Any) -> None:
    arrays: Arrays = {}
    values = to_json(value, arrays, kinds)
    if arrays:
        write_npz(arrays_path, arrays, compressed=True)
    write_json(path, {"format": FORMAT, "version": VERSION, **values})


def _read(path: Path, arrays_path: Path, kinds: Any) -> Any:
    values = read_json(path)
    named = isinstance(values, dict) and (values.pop("format", 0), values.pop("version", 0))
    if named != (FORMAT, VERSION):
        known = f"(format '{FORMAT}', version {VERSION})"
        raise StgaError(f"{path}: is not a request that this version reads {known}")
    arrays = read_npz(arrays_path) if os.path.exists(arrays_path) else {}
    try:
        return from_json(kinds, values, arrays=arrays)
    except StgaError as error:
        raise StgaError(f"{path}: {error}") from error
