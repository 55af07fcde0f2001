"""Running kernels on several threads, which works because kernels release the GIL.

Numba's parallel loops would compile every kernel four times over (7 s instead of 2 for the image
loss), hold the lock while they run, so that Blender's window waits for a picture rendered in its
background, and crash where two threads call them at once.

The helping threads stay in compiled code, without Python's lock: the calling thread writes a
kernel's address and arguments where they look for it. They look for SPIN_S, and then sleep until
they are woken. Who comes late finds no work, and nobody waits for him.
"""

import atexit
import os
from collections.abc import Callable
from ctypes import c_void_p, pythonapi
from functools import wraps
from threading import Lock, Thread
from time import perf_counter
from types import FunctionType
from typing import Any

import numpy as np
from numba import typeof, types

from . import jit, part_jit
from .elementary import compare_exchange, exchange, fetch_add, load, pause
from .entry import (
    ARGUMENTS,
    ARGUMENTS_WORDS,
    FAILURE,
    KERNEL,
    number_of,
    number_of_type,
    raise_failure,
    run_entry,
    store_entry,
)  # fmt: skip

UNITS, PIECE = 1, 2
"""Where a kernel's `work` (3,) int64 holds the number of units and those of a piece; first is the
next unit."""
SPIN_S = 2e-4
"""For how long a thread looks for work or waits for others before it sleeps: longer than most of
the time between two kernels of an iteration, and little of what a busy machine's other programs
would get."""

# Words of a team, int64. STATE: threads that may still join the kernel, times SEAT; threads in it,
# times 1; and SLEEPS if its caller waits asleep for these.
STATE, SEAT, SLEEPS = 0, 1 << 32, 1 << 31
HELPERS, SPINS, CALLER_LOCK, STOPPED = 16, 17, 18, 19
FIRST_HELPER, HELPER_WORDS, ASLEEP = ARGUMENTS + ARGUMENTS_WORDS, 8, 1
"""Where the words of each helper are: its lock, and whether it sleeps until that is released."""
MAX_HELPERS = 255

_acquire = types.ExternalFunction("PyThread_acquire_lock", types.int32(types.intp, types.int32))
_release = types.ExternalFunction("PyThread_release_lock", types.void(types.intp))

_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """How many threads a kernel runs on: by default, as many as this process may use processors."""
    return _threads


def set_threads(count: int) -> None:
    """Run kernels on `count` threads from now on, at least one."""
    global _threads
    _threads = max(1, count)


def start_threads() -> None:
    """Start the threads that kernels run on, one at least, so that no kernel waits until what they
    run is compiled."""
    _team.start(max(1, _threads - 1))


def parallel(units: Callable[..., int], piece: int = 1) -> Callable[[Any], Callable[..., None]]:
    """Make the compiled kernel(work, *arguments) a function of the arguments alone that runs on all
    threads.

    units: how many units of work the arguments hold. Each thread calls the kernel once, and in
    there takes one piece after the other, by `next_piece`. A kernel must do a unit whatever the
    others do, and write what no other unit writes, so that results do not depend on the threads.
    piece: units that are taken at a time; there are at most as many threads as pieces, so one
    should take longer than to wake a thread.
    """

    def decorate(kernel: Any) -> Callable[..., None]:
        team_kernel = TeamKernel(kernel)

        @wraps(kernel)
        def call(*arguments: Any) -> None:
            count = units(*arguments)
            if not count:
                return
            work, team = np.array([0, count, piece], np.int64), _team
            if team.is_led.acquire(blocking=False):
                try:
                    helpers = team.start(min(_threads, -(-count // piece)) - 1)
                    team_kernel.call(team.words, helpers, (work, *arguments))
                finally:
                    team.is_led.release()
            else:  # another thread leads them
                team_kernel.call(np.zeros(FIRST_HELPER, np.int64), 0, (work, *arguments))

        return call

    return decorate


@part_jit
def next_piece(work):
    """First and past-the-last unit of a piece that no thread has taken before; the same number if
    none is left."""
    begin = fetch_add(work, 0, work[PIECE])
    return min(begin, work[UNITS]), min(begin + work[PIECE], work[UNITS])


class TeamKernel:
    """A kernel as compiled for several types of arguments, and the function that calls it on a
    team."""

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel
        # A function of its own for each kernel, because two processes that compile must not write
        # to the same cache.
        own = FunctionType(_lead.__code__, globals(), f"lead_{kernel.__name__}")
        own.__qualname__ = own.__name__
        self.lead = jit(own)
        self.addresses = np.empty((0, 2), np.int64)

    def call(self, words: np.ndarray, helpers: int, arguments: tuple[Any, ...]) -> None:
        """Call it on this thread and so many helpers of a team."""
        while not self.lead(words, self.addresses, helpers, arguments):
            self._compile(arguments)
        if words[FAILURE]:
            raise_failure(words)

    def _compile(self, arguments: tuple[Any, ...]) -> None:
        """Compile for arguments of these types, or load it, and note the address."""
        kind = typeof(arguments)
        self.kernel.compile(tuple(kind))
        compiled = self.kernel.overloads[tuple(kind)]
        address = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
        new = np.array([[number_of(kind), address]], np.int64)
        self.addresses = np.concatenate([self.addresses, new])


class Team:
    """Threads that help with kernels, of one calling thread at a time.

    words: what they share, see STATE; is_led: held by the calling thread.
    """

    def __init__(self) -> None:
        self.is_led = Lock()
        self.words = np.zeros(FIRST_HELPER + HELPER_WORDS * MAX_HELPERS, np.int64)
        self._helpers: list[Thread] = []

    def start(self, count: int) -> int:
        """Make sure that `count` threads help, as far as there may be so many; returns how many."""
        count = min(count, MAX_HELPERS)
        while len(self._helpers) < count:
            if not self._helpers:
                self.words[CALLER_LOCK] = _new_lock()
                self.words[SPINS] = spins_of(SPIN_S)
            place = FIRST_HELPER + HELPER_WORDS * len(self._helpers)
            self.words[place] = _new_lock()
            arguments = self.words, place
            helper = Thread(target=_help, args=arguments, name="stga kernels", daemon=True)
            self._helpers.append(helper)
            helper.start()
        return count

    def stop(self) -> None:
        """End the threads, which must not run on where Python takes down the code that they are
        in."""
        with self.is_led:
            self.words[STOPPED] = 1
            for n, helper in enumerate(self._helpers):
                lock = int(self.words[FIRST_HELPER + HELPER_WORDS * n])
                pythonapi.PyThread_release_lock(c_void_p(lock))
                helper.join()
            self._helpers.clear()
            self.words[:] = 0


def spins_of(seconds: float) -> int:
    """How many turns of a waiting loop take so long."""
    turns, times = 200, []
    for _ in range(5):  # the first compiles; others may be interrupted
        begin = perf_counter()
        _spin(turns)
        times.append(perf_counter() - begin)
    return max(1, int(turns * seconds / max(min(times), 1e-9)))


@jit
def _spin(count):
    for _ in range(count):
        pause()


def _new_lock() -> int:
    """Address of one of Python's locks that is taken: whoever releases it wakes the thread that
    waits for it."""
    pythonapi.PyThread_allocate_lock.restype = c_void_p
    lock = pythonapi.PyThread_allocate_lock()
    pythonapi.PyThread_acquire_lock(c_void_p(lock), 1)
    return lock


def _lead(words, addresses, helpers, arguments):
    """Call a kernel with the arguments on this thread and so many helpers; false if it is not among
    the addresses."""
    number, kernel = number_of_type(arguments), 0
    for n in range(len(addresses)):
        if addresses[n, 0] == number:
            kernel = addresses[n, 1]
    if kernel == 0:
        return False
    store_entry(words, arguments)
    words[KERNEL], words[FAILURE], words[HELPERS] = kernel, 0, helpers
    if helpers > 0:
        exchange(words, STATE, helpers * SEAT)
        _wake_two(words)
    run_entry(words)
    if helpers > 0:
        _wait_for_helpers(words)
    return True


@part_jit
def _wait_for_helpers(words):
    """Let no more threads join, and wait for those that have."""
    state = load(words, STATE)
    while compare_exchange(words, STATE, state, state % SEAT) == 0:
        state = load(words, STATE)
    spins = 0
    while load(words, STATE) != 0:
        pause()
        spins += 1
        if spins > words[SPINS]:
            if fetch_add(words, STATE, SLEEPS) != 0:
                _acquire(words[CALLER_LOCK], 1)
            exchange(words, STATE, 0)


@part_jit
def _wake_two(words):
    """Wake two helpers, if so many sleep: these wake two each, so that nobody has to wake them
    all."""
    woken = 0
    for n in range(words[HELPERS]):
        place = FIRST_HELPER + HELPER_WORDS * n
        if load(words, place + ASLEEP) == 1 and exchange(words, place + ASLEEP, 0) == 1:
            _release(words[place])
            woken += 1
            if woken == 2:
                return


@part_jit
def _join(words):
    """Whether there is a kernel to help with; this thread is then among those that its caller waits
    for."""
    state = load(words, STATE)
    while state >= SEAT:
        if compare_exchange(words, STATE, state, state - SEAT + 1):
            return True
        state = load(words, STATE)
    return False


@jit
def _help(words, place):
    """Help with kernels until the team is stopped; place: of this helper's words."""
    spins = 0
    while load(words, STOPPED) == 0:
        if _join(words):
            if load(words, STATE) >= SEAT:
                _wake_two(words)
            run_entry(words)
            if fetch_add(words, STATE, -1) == SLEEPS + 1:
                _release(words[CALLER_LOCK])
            spins = 0
        elif spins < words[SPINS]:
            pause()
            spins += 1
        else:
            exchange(words, place + ASLEEP, 1)
            # After this, who has work or stops the team sees that this thread sleeps; what came
            # before, it sees here.
            if (load(words, STATE) < SEAT and load(words, STOPPED) == 0) or exchange(
                words, place + ASLEEP, 0
            ) == 0:
                _acquire(words[place], 1)
            spins = 0


_team = Team()


def _after_fork() -> None:
    """A forked process has none of its parent's threads."""
    global _team
    _team = Team()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
atexit.register(lambda: _team.stop())
