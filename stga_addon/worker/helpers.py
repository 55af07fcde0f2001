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
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from traceback import format_exc
from typing import IO, Any, BinaryIO

import numpy as np

from ..errors import StgaError
from ..files import read_npz, write_npz
from .launch import start_piped
from .machine import processors
from .training_python import this_python

MAX_HELPERS = 8  # Each takes some 300 MB
THREADS_VARIABLE = "OMP_NUM_THREADS"
SINGLE = dict.fromkeys(
    (THREADS_VARIABLE, "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)  # Environment variables of a helper
REPORT_INTERVAL_S = 0.2
STEPS_KEY = "steps"  # Key, in the file of a kept result, of how many steps it took
# A helper's message is a pair of this and a value
STEP = "step"
RESULT = "result"
ERROR = "error"

Step = Callable[[], None]  # Called by work after each of its steps


class Helpers:
    """Processes that are started when there is work for two, and end with the `with` block.

    limit: how many at most; None: one per processor or thread in OMP_NUM_THREADS, up to
    MAX_HELPERS. With one, all work is done in this process. folder: of the results that `map`
    keeps; None: none is kept.
    """

    def __init__(self, limit: int | None = None, folder: Path | None = None) -> None:
        threads = os.environ.get(THREADS_VARIABLE, "")
        default = min(int(threads) if threads.isdecimal() else processors(), MAX_HELPERS)
        self._count = default if limit is None else limit
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> "Helpers":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """End the processes, whatever they are working on."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            with process:  # closes its pipes, and waits
                pass
        self._processes = []

    def map(
        self,
        work: Callable[..., Any],
        parts: Sequence[tuple],
        done: Callable[[int], None],
        keep: bool = False,
    ) -> list[Any]:
        """The results of work(*part, step) of every part, in order.

        work: a function of a module, which calls `step` after each of its steps; parts and results
        can be pickled.
        done: called with how many steps there were, of all parts together; what it raises ends the
        work. keep: results are arrays by name; each is kept in the folder as soon as there is one,
        and read from there instead of working on an equal part again. Raises what work raises, and
        StgaError where a helper ends before its work does.
        """
        if keep:
            work, parts = self._keeping(work, parts)
        if min(self._count, len(parts)) >= 2:
            return self._shared(work, parts, done)
        steps = count(1)
        return [work(*part, lambda: done(next(steps))) for part in parts]

    def run(
        self,
        work: Callable[..., Any],
        part: tuple,
        done: Callable[[int], None],
        keep: bool = False,
        apart: bool = False,
    ) -> Any:
        """The result of work(*part, step) of one helper, as `map`; for what is not worth two.
        apart: never in this process, for what `done` could not end there."""
        parts: Sequence[tuple] = [part]
        if keep:
            work, parts = self._keeping(work, parts)
        shared = self._shared if self._count >= 2 or apart else self.map
        return shared(work, parts, done)[0]

    def _keeping(
        self, work: Callable[..., Any], parts: Sequence[tuple]
    ) -> tuple[Callable[..., Any], Sequence[tuple]]:
        """Work and parts whose results are kept in the folder; as they are without one."""
        if self._folder is None:
            return work, parts
        files = [self._folder / f"{_digest(work, part)}.npz" for part in parts]
        return _kept, [(file, work, part) for file, part in zip(files, parts, strict=True)]

    def _shared(
        self, work: Callable[..., Any], parts: Sequence[tuple], done: Callable[[int], None]
    ) -> list[Any]:
        """The results of as many helping processes as there are parts for."""
        number = min(max(self._count, 1), len(parts))
        while len(self._processes) < number:
            self._processes.append(_start())
        idle: SimpleQueue[subprocess.Popen[bytes]] = SimpleQueue()
        for process in self._processes[:number]:
            idle.put(process)
        steps: list[None] = []  # threads append one for each

        def answer(part: tuple) -> Any:
            process = idle.get()
            assert process.stdin is not None
            assert process.stdout is not None
            try:
                _send(process.stdin, (work, part))
                while (message := _Unpickler(process.stdout).load())[0] == STEP:
                    steps.append(None)
            except (EOFError, OSError, pickle.UnpicklingError) as error:
                raise StgaError(
                    f"a helping process ended before its work did (exit status {process.poll()})"
                ) from error
            idle.put(process)
            if message[0] == ERROR:
                raise message[1]
            return message[1]

        pool = ThreadPoolExecutor(number)
        try:
            answers = [pool.submit(answer, part) for part in parts]
            waiting: Collection[Future[Any]] = answers
            while waiting:
                ended, waiting = wait(waiting, REPORT_INTERVAL_S, FIRST_EXCEPTION)
                for one in ended:
                    one.result()
                done(len(steps))
            return [one.result() for one in answers]
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _digest(work: Callable[..., Any], part: tuple) -> str:
    """Changes with any of the arguments."""
    arguments = pickle.dumps((work.__qualname__, part), pickle.HIGHEST_PROTOCOL)
    return hashlib.sha256(arguments).hexdigest()[:32]


def _kept(
    file: Path, work: Callable[..., dict[str, Any]], part: tuple, step: Step
) -> dict[str, Any]:
    """The result of work(*part, step), read from the file where it is whole, else written there."""
    with suppress(StgaError, KeyError, TypeError):
        found = read_npz(file)
        for _ in range(int(found.pop(STEPS_KEY))):
            step()
        return found
    taken = 0

    def counted() -> None:
        nonlocal taken
        taken += 1
        step()

    found = work(*part, counted)
    write_npz(file, {**found, STEPS_KEY: np.array(taken)})
    return found


def _start() -> "subprocess.Popen[bytes]":
    return start_piped(this_python(), ["stga_addon.worker.helpers"], SINGLE)


class _Unpickler(pickle.Unpickler):
    """Finds this package's names under its name in this process: another one in Blender."""

    def find_class(self, module: str, name: str) -> Any:
        package = (__package__ or "").removesuffix(".worker")
        return super().find_class(re.sub(r"^(.+\.)?stga_addon(?=\.)", package, module), name)


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
