"""Running kernels on several threads, which works because kernels release the GIL.

Numba's parallel loops would compile every kernel four times over (7 s instead of 2 for the image
loss), hold the lock while they run, so that Blender's window waits for a picture rendered in its
background, and crash where two threads call them at once.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from typing import Any

import numpy as np
from numba import njit

from . import jit
from .elementary import fetch_add

UNITS = 1
PIECE = 2
"""Where a kernel's `work` (3,) int64 holds the number of units and those of a piece; first is the
next unit."""

_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_pool: ThreadPoolExecutor


def threads() -> int:
    """How many threads a kernel runs on: by default, as many as this process may use processors."""
    return _threads


def set_threads(count: int) -> None:
    """Run kernels on `count` threads from now on, at least one."""
    global _threads, _pool
    _threads = max(1, count)
    # Starts threads when they are needed. Those of the pool that it replaces end.
    _pool = ThreadPoolExecutor(max(1, _threads - 1), "stga kernels")


def parallel(units: Callable[..., int], piece: int = 1) -> Callable[[Any], Callable[..., None]]:
    """Compile kernel(work, *arguments) to a function of the arguments alone that runs on all
    threads.

    units: how many units of work the arguments hold. Each thread calls the kernel once, and in
    there takes one piece after the other, by `pieces`. A kernel must do a unit whatever the
    others do, and write what no other unit writes, so that results do not depend on the threads.
    piece: units that are taken at a time; there are at most as many threads as pieces, so one
    should take longer than to wake a thread.
    """

    def decorate(function: Any) -> Callable[..., None]:
        kernel = jit(function)

        @wraps(kernel)
        def call(*arguments: Any) -> None:
            if count := units(*arguments):
                _run(kernel, count, piece, arguments)

        return call

    return decorate


def _run(kernel: Any, units: int, piece: int, arguments: tuple[Any, ...]) -> None:
    """Call a kernel on this thread and others, and wait until all its units are done."""
    work = np.array([0, units, piece], np.int64)
    others = min(_threads, -(-units // piece)) - 1
    helpers = [_pool.submit(kernel, work, *arguments) for _ in range(others)]
    try:
        kernel(work, *arguments)
    finally:
        # One that has not begun would find no work, and nobody waits for it.
        errors = [helper.exception() for helper in helpers if not helper.cancel()]
    for error in errors:
        if error is not None:
            raise error


@njit  # not cached, because Numba cannot compile a call of a generator that is
def pieces(work):
    """First and past-the-last unit of each piece that no other thread takes."""
    begin = fetch_add(work, 0, work[PIECE])
    while begin < work[UNITS]:
        yield begin, min(begin + work[PIECE], work[UNITS])
        begin = fetch_add(work, 0, work[PIECE])


set_threads(_threads)
if hasattr(os, "register_at_fork"):  # a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=lambda: set_threads(_threads))
