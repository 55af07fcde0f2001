"""Running kernels on several Python threads, which works because kernels release the GIL.

Numba's parallel loops would compile every kernel four times over (7 s instead of 2 for the image loss), hold the lock
while they run, so that Blender's window waits for a picture rendered in its background, and crash where two threads
call them at once.
"""

import os
from collections.abc import Callable
from functools import wraps
from queue import SimpleQueue
from threading import Thread
from typing import Any

PIECES_PER_THREAD = 8
"""More pieces than threads, so that a thread which finishes early takes over work."""
EVEN_PIECES = 4
"""The same for kernels whose units all cost alike."""
MANY_THREADS = 8
"""From here on, threads get fewer pieces each: every call of a kernel holds Python's lock while its arguments are
unpacked, up to 20 µs, for which all other threads wait."""

_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_tasks: SimpleQueue[Callable[[], None]] = SimpleQueue()
_waiting = 0
"""Threads that were started to take from `_tasks`."""


def threads() -> int:
    """How many threads a kernel runs on: by default, as many as this process may use processors."""
    return _threads


def set_threads(count: int) -> None:
    """Run kernels on `count` threads from now on, at least one."""
    global _threads
    _threads = max(1, count)


def parallel(
    units: Callable[..., int], pieces: int = PIECES_PER_THREAD, least: int = 1
) -> Callable[[Any], Callable[..., None]]:
    """Make kernel(begin, end, *arguments) a function of the arguments alone that runs on all threads.

    units: how many units of work the arguments hold; a kernel must do [begin, end) of them whatever the others do, and
    write what no other unit writes, so that results do not depend on the threads. pieces: a thread, of equal length.
    least: units of a piece, so many that they take longer than to wake a thread.
    """

    def decorate(kernel: Any) -> Callable[..., None]:
        @wraps(kernel)
        def call(*arguments: Any) -> None:
            _run(kernel, cut(units(*arguments), pieces, least), arguments)

        return call

    return decorate


def pieces_of(pieces: int = PIECES_PER_THREAD) -> int:
    """How many pieces of work there are, where few threads get `pieces` each."""
    return _threads * max(2, min(pieces, pieces * MANY_THREADS // _threads)) if _threads > 1 else 1


def cut(units: int, pieces: int = PIECES_PER_THREAD, least: int = 1) -> list[tuple[int, int]]:
    """First and past-the-last unit of each piece of work; see `parallel`."""
    size = max(least, -(-units // pieces_of(pieces)))
    return [(begin, min(begin + size, units)) for begin in range(0, units, size)]


def _run(kernel: Any, parts: list[tuple[int, int]], arguments: tuple[Any, ...]) -> None:
    """Call the kernel for each part; the parts are those of `cut`."""
    if len(parts) == 1:
        kernel(*parts[0], *arguments)
        return
    remaining = iter(parts)  # shared: under Python's lock, each piece is taken once
    finished: SimpleQueue[BaseException | None] = SimpleQueue()

    def work() -> None:
        for begin, end in remaining:
            kernel(begin, end, *arguments)

    def assist() -> None:
        try:
            work()
        except BaseException as error:  # is raised in the calling thread, which waits for this one
            finished.put(error)
        else:
            finished.put(None)

    helpers = min(_threads, len(parts)) - 1
    _start(helpers)
    for _ in range(helpers):
        _tasks.put(assist)
    try:
        work()
    finally:
        errors = [finished.get() for _ in range(helpers)]
    for error in errors:
        if error is not None:
            raise error


def _start(count: int) -> None:
    """Make sure that at least `count` threads wait for work."""
    global _waiting
    while _waiting < count:
        _waiting += 1
        Thread(target=_run_tasks, name="stga kernels", daemon=True).start()


def _run_tasks() -> None:
    while True:
        _tasks.get()()


def _after_fork() -> None:
    """A forked process has none of its parent's threads."""
    global _tasks, _waiting
    _tasks, _waiting = SimpleQueue(), 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
