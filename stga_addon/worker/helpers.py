"""Helping processes: the parts of a task are worked on by several at once, with one thread of
linear algebra each.

For work that is many small steps of NumPy, which threads do not share: each step holds Python's
lock, and BLAS divides matrices among threads that are too small for it.
"""

import hashlib
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from traceback import format_exc
from types import TracebackType
from typing import IO, Any, BinaryIO

import numpy as np

from ..errors import StgaError
from ..files import read_npz, write_npz
from .launch import end_with_this_process, start_python
from .training_python import own_python

MAX_HELPERS = 8  # Each takes some 300 MB
THREADS_VARIABLE = "OMP_NUM_THREADS"
SINGLE = dict.fromkeys(
    (THREADS_VARIABLE, "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)  # Environment variables of a helper
REPORT_INTERVAL_S = 0.2
STEPS_KEY = "steps"  # In the file of a kept result: how many steps it took
STEP, RESULT, ERROR = "step", "result", "error"
"""What a helper's messages are: a pair of this and a value."""

Step = Callable[[], None]  # Called by work after each of its steps


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Helpers:
    """Processes that are started when there is work for two, and end with the `with` block.

    count: how many at most; None: one per processor or thread in OMP_NUM_THREADS, up to
    MAX_HELPERS. With one, all work is done in this process. folder: of the results that `map`
    keeps; None: none is kept.
    """

    def __init__(self, count: int | None = None, folder: Path | None = None) -> None:
        limit = os.environ.get(THREADS_VARIABLE, "")
        usual = min(int(limit) if limit.isdecimal() else processors(), MAX_HELPERS)
        self._count, self._folder = usual if count is None else count, folder
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> "Helpers":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.end()

    def end(self) -> None:
        """End the processes, whatever they are working on."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                pipe.close()
        self._processes = []

    def map(
        self, work: Callable[..., Any], parts: Sequence[tuple], done: Callable[[int], None],
        keep: bool = False,
    ) -> list[Any]:  # fmt: skip
        """The results of work(*part, step) of every part, in order.

        work: a function of a module, which calls `step` after each of its steps; parts and results
        can be pickled.
        done: is told how many steps there were, of all parts together; what it raises ends the
        work. keep: results are arrays by name; each is kept in the folder as soon as there is one,
        and read from there instead of working on an equal part again. Raises what work raises, and
        StgaError where a helper ends before its work does.
        """
        if keep and self._folder is not None:
            work, parts = (
                _kept,
                [(self._folder / f"{_digest(work, part)}.npz", work, part) for part in parts],
            )
        count = min(self._count, len(parts))
        if count < 2:
            steps = _Counter()
            return [work(*part, lambda: done(steps.add())) for part in parts]
        return self._shared(work, parts, done, count)

    def run(self, work: Callable[..., Any], part: tuple, done: Callable[[int], None]) -> Any:
        """The result of work(*part, step) of one helper, as `map`; for what is not worth two."""
        if self._count < 2:
            return self.map(work, [part], done)[0]
        return self._shared(work, [part], done, 1)[0]

    def _shared(
        self, work: Callable[..., Any], parts: Sequence[tuple], done: Callable[[int], None],
        count: int,
    ) -> list[Any]:  # fmt: skip
        """The results of so many helping processes."""
        while len(self._processes) < count:
            self._processes.append(_start())
        task = _Task(work, parts)
        threads = [
            Thread(target=task.feed, args=(process,), daemon=True)
            for process in self._processes[:count]
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            while thread.is_alive() and not task.errors:
                thread.join(REPORT_INTERVAL_S)
                done(task.steps.value)
        if task.errors:
            raise task.errors[0]
        done(task.steps.value)
        return task.results


def _digest(work: Callable[..., Any], part: tuple) -> str:
    """Changes with any of the arguments."""
    return hashlib.sha256(
        pickle.dumps((work.__qualname__, part), pickle.HIGHEST_PROTOCOL)
    ).hexdigest()[:32]


def _kept(
    file: Path, work: Callable[..., dict[str, Any]], part: tuple, step: Step
) -> dict[str, Any]:
    """The result of work(*part, step), read from the file where it is whole, else written there."""
    with suppress(StgaError, KeyError, TypeError):
        found = read_npz(file)
        for _ in range(int(found.pop(STEPS_KEY))):
            step()
        return found
    steps = _Counter()

    def counted() -> None:
        steps.add()
        step()

    found = work(*part, counted)
    write_npz(file, {**found, STEPS_KEY: np.array(steps.value)})
    return found


class _Counter:
    """A number that threads add to."""

    def __init__(self) -> None:
        self.value, self._lock = 0, Lock()

    def add(self) -> int:
        with self._lock:
            self.value += 1
            return self.value


class _Task:
    """What `Helpers.map` does at a time: parts that are left, results and errors."""

    def __init__(self, work: Callable[..., Any], parts: Sequence[tuple]) -> None:
        self.results: list[Any] = [None] * len(parts)
        self.errors: list[BaseException] = []
        self.steps, self._work = _Counter(), work
        self._left: SimpleQueue[tuple[int, tuple]] = SimpleQueue()
        for numbered in enumerate(parts):
            self._left.put(numbered)

    def feed(self, process: "subprocess.Popen[bytes]") -> None:
        """Hand parts to a process until none is left."""
        try:
            while not self.errors:
                number, part = self._left.get_nowait()
                self.results[number] = self._answer(process, part)
        except Empty:
            return
        except (EOFError, OSError, pickle.UnpicklingError):
            code = process.poll()
            self.errors.append(
                StgaError(f"a helping process ended before its work did (exit status {code})")
            )
        except BaseException as error:  # raised again by the thread that waits
            self.errors.append(error)

    def _answer(self, process: "subprocess.Popen[bytes]", part: tuple) -> Any:
        assert process.stdin is not None
        assert process.stdout is not None
        _send(process.stdin, (self._work, part))
        while True:
            kind, value = _Unpickler(process.stdout).load()
            if kind == STEP:
                self.steps.add()
            elif kind == ERROR:
                raise value
            else:
                return value


def _start() -> "subprocess.Popen[bytes]":
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    quiet = (
        {"creationflags": 0x08000000}
        if os.name == "nt"
        else {"preexec_fn": end_with_this_process()}
    )
    return start_python(own_python(), ["stga_addon.worker.helpers"], SINGLE, **pipes, **quiet)


class _Unpickler(pickle.Unpickler):
    """Finds this package's names under its name in this process: another one in Blender."""

    def find_class(self, module: str, name: str) -> Any:
        own = (__package__ or "").removesuffix(".worker")
        return super().find_class(re.sub(r"^(.+\.)?stga_addon(?=\.)", own, module), name)


def _send(stream: IO[bytes], message: Any) -> None:
    pickle.dump(message, stream, pickle.HIGHEST_PROTOCOL)
    stream.flush()


def claim_stdout() -> BinaryIO:
    """Return a stream on standard output, and send whatever else is written there to standard
    error.

    Call it before anything that may print is imported: libraries in C write to descriptor 1,
    whatever `sys.stdout` is.
    """
    sys.stdout.flush()
    try:
        os.fstat(2)
    except OSError:  # standard error is closed
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    messages = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return messages


def help_until_closed() -> None:
    """Work on what comes from stdin, and answer on stdout, until the asker has gone."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks
    answers = claim_stdout()
    while True:
        try:
            work, part = _Unpickler(sys.stdin.buffer).load()
        except EOFError:
            return
        try:
            answer = RESULT, work(*part, lambda: _send(answers, (STEP, None)))
        except StgaError as error:
            answer = ERROR, error
        except Exception:
            answer = ERROR, RuntimeError(format_exc())
        _send(answers, answer)


if __name__ == "__main__":
    help_until_closed()
