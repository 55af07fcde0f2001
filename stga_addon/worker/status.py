"""Status of a worker process, shared through a folder.

status.json   the worker's latest status, replaced atomically
preview.npz   of a training: the avatar of a few seconds ago
picture.npz   of a tracking: the head over the footage and its mesh, `Progress.picture`
worker.log    its standard output and error
worker.lock   locked while the worker lives
cancel        exists once the worker was asked to stop
"""

import math
import os
import platform
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import RENAME_PATIENCE_S, file_size, naming, read_json, write_json, write_npz
from ..progress import Clock, Progress, after_silence
from ..schema import from_json, setting
from .lock import hold_folder, is_locked, lock_owner

STATUS_FILE = "status.json"
LOG_FILE = "worker.log"
LOCK_FILE = "worker.lock"
CANCEL_FILE = "cancel"
PREVIEW = "preview.npz"
PICTURE = "picture.npz"
STATUS_INTERVAL_S = 0.5  # Least time between two writes of status.json with the same message
PREVIEW_INTERVAL_S = 4.0  # Seconds between two previews
MIN_FREE_BYTES = 1 << 20  # Free space below which a disk counts as full
LOG_TAIL_LINES = 6
REPORT_LOG_LINES = 200
MAX_LOG_LINE_BYTES = 400  # Assumed length of a log line, which bounds how much of the log is read


class WorkerState(StrEnum):
    """State of a worker, derived from its folder and whether its process lives."""

    NONE = "none"
    STARTING = "starting"
    WORKING = "working"
    CANCELLING = "cancelling"
    FINISHED = "finished"
    CANCELLED = "cancelled"
    FAILED = "failed"
    LOST = "lost"

    @property
    def is_alive(self) -> bool:
        return self in (WorkerState.STARTING, WorkerState.WORKING, WorkerState.CANCELLING)

    @property
    def failed(self) -> bool:
        return self in (WorkerState.FAILED, WorkerState.LOST)


@dataclass(frozen=True)
class WorkerStatus:
    """Content of status.json.

    message   what the worker is doing; detail: a second line about it
    error     one sentence, and the traceback where a bug caused it
    figures   named numbers that depend on the kind of work
    machine   name of the computer
    seconds   of work so far
    """

    state: str = setting(
        WorkerState.WORKING, choices=("working", "finished", "cancelled", "failed")
    )
    progress: float = setting(0.0, 0, 1)
    message: str = ""
    detail: str = ""
    error: str = ""
    traceback: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    machine: str = ""
    seconds: float = setting(0.0, 0)


@dataclass(frozen=True)
class WorkerSnapshot:
    """State and status of a worker; `log_tail`: the last lines of its log where it failed."""

    state: WorkerState = WorkerState.NONE
    status: WorkerStatus = field(default_factory=WorkerStatus)
    log_tail: tuple[str, ...] = ()


# Reading


def inspect_worker(folder: Path, process: subprocess.Popen[bytes] | None = None) -> WorkerSnapshot:
    """Snapshot of a status folder; `process`: its worker, where this process started it."""
    code = None if process is None else process.poll()
    # The process before the status: one that ends between the two reads has written its final
    # status by then.
    alive = (process is not None and code is None) or is_locked(folder / LOCK_FILE)
    status = read_status(folder)
    cancelled, started = ((folder / name).exists() for name in (CANCEL_FILE, LOG_FILE))
    if status is not None and status.state != WorkerState.WORKING:
        state = WorkerState(status.state)
    elif not alive:
        state = WorkerState.LOST if started else WorkerState.NONE
    elif cancelled:
        state = WorkerState.CANCELLING
    else:
        state = WorkerState.STARTING if status is None else WorkerState.WORKING
    status = status or WorkerStatus()
    if state.is_alive:
        with suppress(OSError):
            silent_s = time.time() - (folder / STATUS_FILE).stat().st_mtime
            status = replace(status, figures=after_silence(status.figures, silent_s))
    if state == WorkerState.LOST:
        error = _why_lost(folder, code)
        status = replace(status, state=WorkerState.LOST, message="", detail="", error=error)
    log_tail = tuple(log_lines(folder, LOG_TAIL_LINES)) if state.failed else ()
    return WorkerSnapshot(state, status, log_tail)


def _why_lost(folder: Path, exit_code: int | None) -> str:
    with suppress(OSError):
        if shutil.disk_usage(folder).free < MIN_FREE_BYTES:
            return f"Worker exited unexpectedly: the disk that holds {folder} is full"
    if exit_code is not None and exit_code > 0:
        last = log_lines(folder, 1) or ["its log is empty"]
        return f"Worker exited with status {exit_code}: {last[0].strip()}"
    signal = f" (signal {-exit_code})" if exit_code else ""
    return (
        f"Worker exited unexpectedly{signal}; it was killed or may have run out of memory. "
        f"Log: {folder / LOG_FILE}"
    )


def read_status(folder: Path) -> WorkerStatus | None:
    """The latest status; None where status.json is missing or malformed."""
    with suppress(StgaError, TypeError):
        values = {**asdict(WorkerStatus()), **read_json(folder / STATUS_FILE)}
        return from_json(WorkerStatus, values)
    return None


def log_lines(folder: Path, count: int) -> list[str]:
    """The last `count` lines of the log that are not empty; none where it cannot be read."""
    path = folder / LOG_FILE
    try:
        file_size(path)
        with path.open("rb") as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - MAX_LOG_LINE_BYTES * count))
            lines = log.read().decode("utf-8", "replace").replace("\r", "\n").splitlines()
    except (StgaError, OSError):
        return []
    return [line.rstrip() for line in lines if line.strip()][-count:]


def failure_report(folder: Path, snapshot: WorkerSnapshot) -> str:
    """Everything known about a failure, to be passed on: sentence, traceback and log."""
    log = log_lines(folder, REPORT_LOG_LINES)
    parts = [snapshot.status.error, snapshot.status.traceback, f"{folder / LOG_FILE}:", *log]
    return "\n".join(part for part in parts if part) + "\n"


def request_cancel(folder: Path) -> None:
    """Ask the worker to stop and to keep what it has. Raises StgaError."""
    path = folder / CANCEL_FILE
    with naming(path), suppress(FileExistsError):
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))


def refuse_running_worker(folder: Path) -> None:
    """Raises StgaError while a worker is running in the folder."""
    if is_locked(folder / LOCK_FILE):
        raise StgaError(
            f"{folder}: another worker is running here (process {lock_owner(folder / LOCK_FILE)})"
        )


def remove_status_folder(folder: Path, other_files: Iterable[str] = ()) -> None:
    """Remove a worker's status and `other_files`, and the folder where nothing else is in it.
    Raises StgaError while the worker is running, or a file stays."""
    refuse_running_worker(folder)
    with naming(folder, "removed"), suppress(NotADirectoryError):
        for name in (STATUS_FILE, LOG_FILE, LOCK_FILE, CANCEL_FILE, *other_files):
            (folder / name).unlink(missing_ok=True)
        with suppress(OSError):  # files of others are in it, or it is gone
            folder.rmdir()


# Writing, by the worker


class StatusWriter:
    """Writes the status of this process, a worker, into its status folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cancel_requested = False
        self._status = WorkerStatus(machine=platform.node())
        self._clock = Clock()
        self._written_s = -math.inf
        self._began_s = self._previewed_s = time.monotonic()

    def report(self, progress: Progress) -> bool:
        """Write the status, at most every STATUS_INTERVAL_S, with the finite figures, a preview now
        and then, and each picture; returns whether to stop and keep what there is."""
        self.cancel_requested = (self.folder / CANCEL_FILE).exists()
        now = time.monotonic()
        if progress.stage != self._status.message or now - self._written_s >= STATUS_INTERVAL_S:
            figures = self._clock.reported(progress)
            said = {"message": progress.stage, "detail": progress.detail, "figures": figures}
            self._written_s = now
            self._write(0.0, progress=self._clock.fraction, **said)
        if progress.preview is not None and now - self._previewed_s > PREVIEW_INTERVAL_S:
            progress.preview(self.folder / PREVIEW)
            self._previewed_s = time.monotonic()
        picture = None if progress.picture is None else progress.picture()
        if picture is not None:
            with suppress(StgaError):  # a full disk, which the work reports itself
                write_npz(self.folder / PICTURE, dict(picture))
        return self.cancel_requested

    def finish(self, state: WorkerState, error: str = "", trace: str = "") -> None:
        """Write the final status."""
        self._write(RENAME_PATIENCE_S, state=state, error=error, traceback=trace)

    def _write(self, patience_s: float, **changes: Any) -> None:
        """patience_s: 0 where the next one comes soon."""
        seconds = round(time.monotonic() - self._began_s, 3)
        self._status = replace(self._status, seconds=seconds, **changes)
        # A missing status stops no work, and `inspect_worker` reports a worker that is gone.
        with suppress(StgaError):
            write_json(self.folder / STATUS_FILE, asdict(self._status), patience_s=patience_s)


@contextmanager
def status_writer(folder: Path) -> Iterator[StatusWriter]:
    """Lock the status folder while the block runs, and write the final status when it ends, however
    it ends.

    Raises what the block raises, and StgaError where another worker is in the folder or it cannot
    be written.
    """
    with hold_folder(folder, LOCK_FILE, "worker is running here"):
        writer = StatusWriter(folder)
        try:
            yield writer
        except StgaError as error:
            writer.finish(WorkerState.FAILED, str(error))
            raise
        except KeyboardInterrupt:
            writer.finish(WorkerState.CANCELLED)
            raise
        except BaseException as error:
            lines = str(error).strip().splitlines()
            summary = ": ".join([type(error).__name__, *lines[:1]])
            if isinstance(error, ModuleNotFoundError):
                summary = f"{sys.executable} lacks the package '{error.name}'"
            writer.finish(WorkerState.FAILED, summary, traceback.format_exc())
            raise
        writer.finish(WorkerState.CANCELLED if writer.cancel_requested else WorkerState.FINISHED)
