"""Work beside Blender: a folder in which a worker process says how far it is, and is asked to stop.

status.json   the worker's last word so far, replaced as a whole
worker.log    what it printed
worker.lock   held by the worker while it lives
cancel        there once it was asked to stop
"""

import math
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import read_json, write_json
from .lock import held, is_held, owner

STATUS, LOG, LOCK, CANCEL = "status.json", "worker.log", "worker.lock", "cancel"
TELL_S = 0.5
"""Seconds between two words of a worker."""
LAST_WORD_S = 5.0
"""How long a worker tries to leave its last word: on Windows, a file that is being read cannot be replaced."""
NICENESS = 5
"""By how much a worker steps back on Linux and macOS."""
FULL_BYTES = 1 << 20
"""A disk with less left than this counts as full."""
PACKAGES = Path(__file__).resolve().parents[2]
"""The folder that `stga_addon` lies in, which a worker needs on its path."""


class State(StrEnum):
    """Where a task stands; nothing but its folder and the life of its worker decides."""

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
        return self in (State.STARTING, State.WORKING, State.CANCELLING)

    @property
    def failed(self) -> bool:
        return self in (State.FAILED, State.LOST)


@dataclass(frozen=True)
class Status:
    """What status.json holds: working, finished, cancelled or failed; the share done; what is going on and a remark on
    it; one sentence and a traceback where it failed; and named figures that belong to the kind of work."""

    state: str = State.WORKING
    share: float = 0.0
    message: str = ""
    remark: str = ""
    error: str = ""
    traceback: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Snapshot:
    """A task as it was when somebody looked; `tail` are the log's last lines where it came to grief."""

    state: State = State.NONE
    status: Status = field(default_factory=Status)
    tail: tuple[str, ...] = ()


def state_of(status: Status | None, alive: bool, asked: bool, begun: bool) -> State:
    """The state of a task.

    status: its last word, or None. alive: whether its worker lives. asked: whether it was asked to stop. begun:
    whether anybody ever started a worker.
    """
    if status is not None and status.state != State.WORKING:
        return State(status.state)
    if not alive:
        return State.LOST if begun else State.NONE
    if asked:
        return State.CANCELLING
    return State.STARTING if status is None else State.WORKING


# The side that starts and watches


def prepare(folder: Path) -> None:
    """Make the folder ready for a worker, with nothing in it from the one before.

    Raises StgaError while that one lives, or where the folder cannot be written.
    """
    _refuse_a_living(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (STATUS, CANCEL):
            (folder / name).unlink(missing_ok=True)
        (folder / LOG).write_bytes(b"")
    except OSError as error:
        raise StgaError(f"{folder}: cannot be written ({error.strerror or error})") from error


def start(folder: Path, python: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start `python -m ARGUMENTS…` with this package on its path; it outlives the process that calls this.

    Its priority is lower: who works in Blender meanwhile comes first. Raises StgaError where there is no such
    interpreter.
    """
    try:
        with (folder / LOG).open("ab") as log:
            process = subprocess.Popen(
                [python, "-m", *arguments], cwd=folder, env=environment(os.environ),
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, **_ON_ITS_OWN,
            )  # fmt: skip
        if os.name != "nt":
            with suppress(OSError):  # it has ended already
                os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + NICENESS)
        return process
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)  # nothing was ever begun
        raise StgaError(f"{python}: cannot be started as a Python interpreter ({error.strerror or error})") from error


def environment(outer: Mapping[str, str]) -> dict[str, str]:
    """What a worker's interpreter is told: where our package lies, and nothing about Blender's own Python."""
    kept = {name: value for name, value in outer.items() if name not in ("PYTHONHOME", "PYTHONSTARTUP")}
    return {
        **kept,
        "PYTHONPATH": str(PACKAGES),
        "PYTHONSAFEPATH": "1",
        "PYTHONDONTWRITEBYTECODE": "1",  # the extension's folder is Blender's
        "PYTHONUNBUFFERED": "1",
        "PYTHONUTF8": "1",
    }


def same_packages(outer: Mapping[str, str]) -> dict[str, str]:
    """What another process of this very interpreter is told: to find every package where this one does."""
    return {**outer, "PYTHONPATH": os.pathsep.join([str(PACKAGES), *filter(None, sys.path)])}


def look(folder: Path, process: subprocess.Popen[bytes] | None = None) -> Snapshot:
    """The task as it is now. process: its worker, where this process started it."""
    code = None if process is None else process.poll()
    # Life before last words: a worker that ends between the two looks has left its word by the second.
    alive = (process is not None and code is None) or is_held(folder / LOCK)
    status = read_status(folder)
    state = state_of(status, alive, (folder / CANCEL).exists(), (folder / LOG).exists())
    status = status or Status()
    if state == State.LOST:
        status = Status(State.LOST, status.share, error=lost_sentence(folder, code), figures=status.figures)
    return Snapshot(state, status, tuple(log_lines(folder, 6)) if state.failed else ())


def lost_sentence(folder: Path, code: int | None = None) -> str:
    """One sentence on a worker that ended without a last word; code: its exit status, where it is known."""
    with suppress(OSError):
        if shutil.disk_usage(folder).free < FULL_BYTES:
            return f"the worker ended without a word, and the disk that holds {folder} is full"
    if code is not None and code > 0:
        last = log_lines(folder, 1)
        return f"the worker ended with exit status {code}: {last[0].strip() if last else 'its log is empty'}"
    how = f"it was killed by signal {-code}" if code else "it was killed, or the computer was switched off"
    return f"the worker ended without a word: {how}; running out of memory ends a process so, too"


def ask_to_stop(folder: Path) -> None:
    """Ask the worker to stop and to keep what it has. Raises StgaError where the folder cannot be written."""
    try:
        (folder / CANCEL).touch()
    except OSError as error:
        raise StgaError(f"{folder / CANCEL}: cannot be written ({error.strerror or error})") from error


def forget(folder: Path) -> None:
    """Remove the folder. Raises StgaError while its worker lives, or where that is not allowed."""
    _refuse_a_living(folder)
    try:
        shutil.rmtree(folder)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise StgaError(f"{folder}: cannot be removed ({error.strerror or error})") from error


def account(folder: Path, snapshot: Snapshot) -> str:
    """All that there is to say about a mishap, for somebody who is to find out: sentence, traceback, log."""
    parts = [snapshot.status.error, snapshot.status.traceback, f"{folder / LOG}:", *log_lines(folder, 200)]
    return "\n".join(part for part in parts if part) + "\n"


def log_lines(folder: Path, most: int) -> list[str]:
    """The last lines of the log that are not empty; none where it cannot be read."""
    with suppress(OSError), (folder / LOG).open("rb") as log:
        log.seek(max(0, log.seek(0, os.SEEK_END) - 400 * most))
        lines = log.read().decode("utf-8", "replace").replace("\r", "\n").splitlines()
        return [line.rstrip() for line in lines if line.strip()][-most:]
    return []


def read_status(folder: Path) -> Status | None:
    """The worker's last word; None where there is none, or none that can be understood."""
    try:
        values = read_json(folder / STATUS)
        status = Status(**values)
        texts = (status.message, status.remark, status.error, status.traceback)
        figures = {str(name): float(value) for name, value in status.figures.items()}
        known = status.state in (State.WORKING, State.FINISHED, State.CANCELLED, State.FAILED)
        if not known or not all(isinstance(text, str) for text in texts) or not 0 <= status.share <= 1:
            return None
    except (StgaError, TypeError, ValueError, AttributeError):
        return None
    return Status(status.state, float(status.share), *texts, figures)


def _refuse_a_living(folder: Path) -> None:
    if is_held(folder / LOCK):
        raise StgaError(f"{folder}: another worker is at work here (process {owner(folder / LOCK)})")


# Windows: neither a console window nor the end of the parent's console reaches the worker; elsewhere: its own session.
_ON_ITS_OWN: dict[str, Any] = (
    {"creationflags": 0x00000200 | 0x08000000 | 0x00004000}  # NEW_PROCESS_GROUP, NO_WINDOW, BELOW_NORMAL_PRIORITY
    if os.name == "nt"
    else {"start_new_session": True}
)


# The worker's side


class Teller:
    """How a worker says where it is."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.stopped = False
        self._status, self._told = Status(), -math.inf

    def tell(
        self, share: float, message: str, remark: str = "", figures: Callable[[], Mapping[str, float]] = dict
    ) -> bool:
        """Say how far the work is, at most every TELL_S; answers whether to stop, keeping what is there.

        figures: called when something is said; what is not finite is left out.
        """
        self.stopped = (self.folder / CANCEL).exists()
        now = time.monotonic()
        if message != self._status.message or now - self._told >= TELL_S:
            finite = {name: value for name, value in figures().items() if math.isfinite(value)}
            self._status = Status(State.WORKING, min(max(share, 0.0), 1.0), message, remark, figures=finite)
            self._told = now
            with suppress(StgaError):  # a word less; the work itself says what is wrong with the disk
                write_json(self.folder / STATUS, asdict(self._status))
        return self.stopped

    def end(self, state: State, error: str = "", trace: str = "") -> None:
        """Leave the last word."""
        last = replace(self._status, state=state, error=error, traceback=trace)
        until = time.monotonic() + LAST_WORD_S
        while True:
            try:
                return write_json(self.folder / STATUS, asdict(last))
            except StgaError:
                if time.monotonic() > until:
                    return None  # `look` finds a worker that is gone
                time.sleep(0.1)


@contextmanager
def telling(folder: Path) -> Iterator[Teller]:
    """Hold the task's folder while the block works, and leave its last word when it ends, however it does.

    Raises what the block raises, and StgaError where another worker is in the folder or it cannot be written.
    """
    with ExitStack() as lock:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock.enter_context(held(folder / LOCK))
        except BlockingIOError:
            _refuse_a_living(folder)
            raise StgaError(f"{folder}: another worker was at work here; try again") from None
        except OSError as error:
            raise StgaError(f"{folder}: cannot be written ({error.strerror or error})") from error
        teller = Teller(folder)
        try:
            yield teller
        except StgaError as error:
            teller.end(State.FAILED, str(error))
            raise
        except BaseException as error:
            teller.end(State.FAILED, _sentence(error), traceback.format_exc())
            raise
        teller.end(State.CANCELLED if teller.stopped else State.FINISHED)


def _sentence(error: BaseException) -> str:
    if isinstance(error, ModuleNotFoundError):
        return f"{sys.executable} lacks the package '{error.name}'"
    lines = str(error).strip().splitlines()
    return ": ".join([type(error).__name__, *lines[:1]])
