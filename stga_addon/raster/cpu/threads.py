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

import numpy as np

from . import part_jit
from .elementary import fetch_add

UNITS, PIECE = 1, 2
"""Where a kernel's `work` (3,) int64 holds the number of units and those of a piece; first is the next unit."""

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


def parallel(units: Callable[..., int], piece: int = 1) -> Callable[[Any], Callable[..., None]]:
    """Make kernel(work, *arguments) a function of the arguments alone that runs on all threads.

    units: how many units of work the arguments hold. Each thread calls the kernel once, because Python's lock is held
    while the arguments are unpacked, up to 20 µs; in there it takes one piece after the other, by `next_piece`. A
    kernel must do a unit whatever the others do, and write what no other unit writes, so that results do not depend on
    the threads. piece: units that are taken at a time; there are at most as many threads as pieces, so one should take
    longer than to wake a thread.
    """

    def decorate(kernel: Any) -> Callable[..., None]:
        @wraps(kernel)
        def call(*arguments: Any) -> None:
            _run(kernel, units(*arguments), piece, arguments)

        return call

    return decorate


@part_jit
def next_piece(work):
    """First and past-the-last unit of a piece that no thread has taken before; the same number if none is left."""
    begin = fetch_add(work, work[PIECE])
    return min(begin, work[UNITS]), min(begin + work[PIECE], work[UNITS])


def _run(kernel: Any, units: int, piece: int, arguments: tuple[Any, ...]) -> None:
    """Do all units of a kernel, on this thread and others."""
    shared = np.array([0, units, piece], np.int64)
    helpers = min(_threads, -(-units // piece)) - 1
    if helpers <= 0:
        if units:
            kernel(shared, *arguments)
        return
    finished: SimpleQueue[BaseException | None] = SimpleQueue()

    def assist() -> None:
        try:
            kernel(shared, *arguments)
        except BaseException as error:  # is raised in the calling thread, which waits for this one
            finished.put(error)
        else:
            finished.put(None)

    _start(helpers)
    for _ in range(helpers):
        _tasks.put(assist)
    try:
        kernel(shared, *arguments)
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
