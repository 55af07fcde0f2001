"""Running kernels on several threads, which works because kernels release the GIL.

Helpers stay in compiled code: the first kernel of an iteration wakes them, and until the last they
find the next one, and its next stage, by themselves. Nobody waits for a helper that has not begun,
so more threads than processors do no harm.

Numba's parallel loops would compile every kernel four times over (7 s instead of 2 for the image
loss), hold the lock while they run, so that Blender's window waits for a picture rendered in its
background, and crash where two threads call them at once.
"""

import atexit
import ctypes
import os
from collections.abc import Callable
from functools import wraps
from itertools import pairwise
from threading import RLock, Thread
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from . import inline_jit, jit
from .elementary import acquire, exchange, fetch_add, latest, pause, release, yield_processor

NEXT, UNITS, PIECE, FAILED, STAGES = range(5)
"""Indices in a kernel's `work` int64 of its next unit, the number of units, the size of a piece,
whether a worker has failed; from STAGES on, each stage's next unit and number of finished units."""
WORKER_WORDS = STAGES + 2 * 14
"""Number of words of `work` that workers see: those above, for up to 14 stages."""
# The caller sees all of the words. Those that many threads write lie apart, because a
# processor's core takes over 64 or 128 bytes at a time.
LIMIT, ENTRY = range(WORKER_WORDS, WORKER_WORDS + 2)
"""Words that hold the number of useful helpers, and the function that calls the kernel with the
arguments in CALL."""
JOB = 48
"""Word that counts kernels; OVER after the last."""
GATE = 64
"""Word that counts the workers in a kernel, plus OPEN as long as others may enter."""
OPEN = 1 << 32
"""Bit of GATE: others may enter."""
OVER = -(1 << 62)
"""Value of JOB after the last kernel."""
CALL = 80
"""First word of the kernel's arguments."""
CALL_WORDS = 512
"""Words for the kernel's arguments."""
SLOTS = CALL + CALL_WORDS
"""First word of the workers' slots. A slot holds whether the worker sleeps, and the lock for which
it then waits."""
SLOT_WORDS = 16
"""Words from one slot to the next."""
CALLER = 0
"""Slot of the thread that calls the kernel."""
PATIENCE = 4000
"""Polls before a worker sleeps, some 0.1 ms: longer than Python takes from one kernel to the next,
shorter than from one iteration to the next."""

PROCESSORS = (
    len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
)
"""Number of processors that this process may use."""
_pool: "ThreadPool"


def threads() -> int:
    """How many threads a kernel runs on: by default, as many as this process may use processors."""
    return _pool.helpers + 1


def set_threads(count: int) -> None:
    """Run kernels on `count` threads from now on, at least one."""
    global _pool
    before = _pool
    _pool = ThreadPool(max(1, count) - 1)
    before.dismiss()


def parallel(units: Callable[..., int], piece: int = 1) -> Callable[[Any], Callable[..., None]]:
    """Compile kernel(work, *arguments) to a function of the arguments alone that runs on all
    threads.

    The kernel begins with `call_helpers(work)`. Each thread calls it once, and in there takes one
    piece after the other, by `pieces`, or goes through stages, by `stage`, to the end. A kernel
    must do a unit whatever the others do, and write what no other unit writes, so that results do
    not depend on the threads.

    units: how many units of work the arguments hold. piece: units that are taken at a time; there
    are at most as many threads as pieces, so one should take longer than to wake a thread.
    """

    def decorate(function: Any) -> Callable[..., None]:
        kernel = jit(function)

        @wraps(kernel)
        def call(*arguments: Any) -> None:
            if count := units(*arguments):
                _pool.run(kernel, count, piece, arguments)

        return call

    return decorate


class ThreadPool:
    """A caller's helpers: threads that are started when they are needed, and sleep when not."""

    def __init__(self, helpers: int) -> None:
        self.helpers = helpers
        self._words = np.zeros(SLOTS + SLOT_WORDS * (helpers + 1), np.int64)
        self._errors: list[BaseException] = []
        self._busy = RLock()  # which only its owner can release
        self._threads: list[Thread] = []

    def run(self, kernel: Any, units: int, piece: int, arguments: tuple[Any, ...]) -> None:
        """Call a kernel on this thread and helpers, until all its units are done; on this one alone
        while another thread has the helpers."""
        limit = min(self.helpers, -(-units // piece) - 1)
        try:
            if limit > 0 and self._busy.acquire(blocking=False):
                self._run_together(kernel, (units, piece, limit), arguments)
                return
        finally:
            # An interrupt may come after any call: before it is known here that they were taken,
            # and after that of `suppress`.
            try:  # noqa: SIM105
                self._busy.release()
            except RuntimeError:  # it is another's, or nobody's
                pass
        work = np.zeros(WORKER_WORDS, np.int64)
        work[UNITS] = units
        work[PIECE] = piece
        kernel(work, *arguments)

    def _run_together(
        self, kernel: Any, sizes: tuple[int, int, int], arguments: tuple[Any, ...]
    ) -> None:
        """`run` with helpers; sizes: units, those of a piece, and how many helpers are of use."""
        if not self._threads:
            self.start()
        words = self._words
        words[:WORKER_WORDS] = 0
        words[UNITS], words[PIECE], words[LIMIT] = sizes
        try:
            kernel(words, *arguments)
        except BaseException as error:
            self._errors.append(error)
            words[FAILED] = 1
            join(words)
        if self._errors:
            first = self._errors[0]  # which made others fail
            self._errors.clear()
            raise first

    def start(self) -> None:
        """Start the helpers; once dismissed, they end at once."""
        new_lock = ctypes.pythonapi.PyThread_allocate_lock
        new_lock.restype = ctypes.c_void_p
        for slot in range(self.helpers + 1):
            lock = self._words[SLOTS + SLOT_WORDS * slot + 1] = new_lock()
            ctypes.pythonapi.PyThread_acquire_lock(ctypes.c_void_p(lock), 0)
        helpers = []
        for slot in range(1, self.helpers + 1):
            # those that there is no processor for would keep others from working
            patience = PATIENCE if slot < PROCESSORS else 0
            given = self._words, slot, patience, self._errors
            helpers.append(Thread(target=_help, args=given, name="stga kernels", daemon=True))
            helpers[-1].start()
        self._threads = helpers

    def dismiss(self) -> None:
        """Let the helpers end, those in a kernel after that."""
        self._words[JOB] = OVER
        if self._threads:
            wake_all(self._words)
        for thread in self._threads:
            thread.join()


def _help(words: np.ndarray, slot: int, patience: int, errors: list[BaseException]) -> None:
    while True:
        try:
            serve(words, slot, patience)
            return
        except BaseException as error:
            errors.append(error)
            words[FAILED] = 1
            leave(words)


@intrinsic
def _keep_call(typing: Any, words: Any) -> Any:
    """Keep the arguments of the kernel that this is a part of, which has no other way to be called
    than by its machine code, and a function that calls it with them; of `work`, WORKER_WORDS
    words."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kernel = builder.function
        values = list(kernel.args[2:])  # after where it returns a value and an error
        values[2] = values[5] = ir.IntType(64)(WORKER_WORDS)  # length and shape of the first array
        # An array begins with two pointers, the first to its count of references. The caller holds
        # the arrays: helpers count none, or the processor's cores would take it from each other.
        for n, (value, following) in enumerate(pairwise(values)):
            if isinstance(value.type, ir.PointerType) and isinstance(
                following.type, ir.PointerType
            ):
                values[n] = value.type(None)
        record = ir.LiteralStructType([value.type for value in values])
        assert context.get_abi_sizeof(record) <= 8 * CALL_WORDS
        kind = context.call_conv.get_function_type(types.none, (types.voidptr,))
        entry = ir.Function(builder.module, kind, f"{kernel.name}.entry")
        entry.linkage = "internal"
        inside = ir.IRBuilder(entry.append_basic_block())
        kept = inside.bitcast(entry.args[2], record.as_pointer())
        loaded = [inside.load(cgutils.gep_inbounds(inside, kept, 0, n)) for n in range(len(values))]
        inside.ret(inside.call(kernel, [*entry.args[:2], *loaded]))
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        place = builder.bitcast(builder.gep(data, [ir.IntType(64)(CALL)]), record.as_pointer())
        for n, value in enumerate(values):
            builder.store(value, cgutils.gep_inbounds(builder, place, 0, n))
        address = builder.ptrtoint(entry, ir.IntType(64))
        builder.store(address, builder.gep(data, [ir.IntType(64)(ENTRY)]))
        return context.get_dummy_value()

    return types.void(words), generate


@intrinsic
def _repeat_call(typing: Any, words: Any) -> Any:
    """Call the kernel that `_keep_call` has kept."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        convention = context.call_conv
        kind = convention.get_function_type(types.none, (types.voidptr,))
        address = builder.load(builder.gep(data, [ir.IntType(64)(ENTRY)]))
        entry = builder.inttoptr(address, kind.as_pointer())
        kept = builder.gep(data, [ir.IntType(64)(CALL)])
        kept = builder.bitcast(kept, ir.IntType(8).as_pointer())
        status, _ = convention.call_function(builder, entry, types.none, (types.voidptr,), (kept,))
        with cgutils.if_unlikely(builder, status.is_error):
            convention.return_status_propagate(builder, status)
        return context.get_dummy_value()

    return types.void(words), generate


@njit
def _wake(words, slot):
    asleep = SLOTS + SLOT_WORDS * slot
    if latest(words, asleep) != 0 and exchange(words, asleep, 0) != 0:
        release(words[asleep + 1])


@njit
def _wake_next(words, slot):
    """Wake the two that a worker wakes: one alone would take longer than they all do."""
    for child in range(2 * slot + 1, min(2 * slot + 2, words[LIMIT]) + 1):
        _wake(words, child)


@njit
def _await_change(words, index, value, slot, patience):
    """Wait until a word no longer has the value, or longer."""
    for _ in range(patience):
        if latest(words, index) != value:
            return
        pause()
    asleep = SLOTS + SLOT_WORDS * slot
    exchange(words, asleep, 1)
    # one who has woken it meanwhile has let the lock go
    if latest(words, index) == value or exchange(words, asleep, 0) == 0:
        acquire(words[asleep + 1])


@jit
def serve(words, slot, patience):
    """Help with every kernel from now on, until the pool is dismissed."""
    known = 0
    while known >= 0:
        while latest(words, JOB) == known:
            _await_change(words, JOB, known, slot, patience)
        known = latest(words, JOB)
        is_left = latest(words, GATE) >= OPEN and latest(words, NEXT) < words[UNITS]
        if is_left and slot <= words[LIMIT]:
            _wake_next(words, slot)
            if fetch_add(words, GATE, 1) >= OPEN:
                _repeat_call(words)
            leave(words)


@jit
def leave(words):
    """Be no longer in a kernel."""
    if fetch_add(words, GATE, -1) == 1:
        _wake(words, CALLER)


@jit
def join(words):
    """Let nobody enter the kernel any more, and wait until all have left."""
    if latest(words, GATE) >= OPEN:
        fetch_add(words, GATE, -OPEN)
    inside = latest(words, GATE)
    while inside != 0:
        _await_change(words, GATE, inside, CALLER, PATIENCE)
        inside = latest(words, GATE)


@jit
def wake_all(words):
    """Let all helpers look what there is to do."""
    for at in range(SLOTS, len(words), SLOT_WORDS):
        if exchange(words, at, 0) != 0:
            release(words[at + 1])


@njit
def _open(words):
    fetch_add(words, GATE, OPEN)
    fetch_add(words, JOB, 1)
    _wake_next(words, CALLER)


@inline_jit
def call_helpers(work):
    """Call the helpers to the kernel that begins with this."""
    if len(work) > WORKER_WORDS:
        _keep_call(work)
        _open(work)


@njit  # not cached, because Numba cannot compile a call of a generator that is
def pieces(work):
    """First and past-the-last unit of each piece that no other thread takes; in the end, the caller
    waits for the others."""
    begin = fetch_add(work, NEXT, work[PIECE])
    while begin < work[UNITS]:
        yield begin, min(begin + work[PIECE], work[UNITS])
        begin = fetch_add(work, NEXT, work[PIECE])
    if len(work) > WORKER_WORDS:
        join(work)


@njit
def stage(work, number, units):
    """Each unit of a kernel's stage that no other thread takes; ends when all are done, those of
    other threads too. Stages are numbered from 0 on; every thread goes through all of them, and
    then to `end_stages`."""
    at = STAGES + 2 * number
    unit = fetch_add(work, at, 1)
    while unit < units:
        yield unit
        fetch_add(work, at + 1, 1)
        unit = fetch_add(work, at, 1)
    looks = 0
    while latest(work, at + 1) < units:
        if latest(work, FAILED) != 0:
            raise RuntimeError("another thread has failed")
        pause()
        looks += 1
        if looks > PATIENCE:
            yield_processor()


@inline_jit
def end_stages(work):
    """Wait, in the caller, until no helper is in the kernel."""
    if len(work) > WORKER_WORDS:
        join(work)


def _restart() -> None:
    global _pool
    _pool = ThreadPool(_pool.helpers)


_pool = ThreadPool(PROCESSORS - 1)
atexit.register(lambda: _pool.dismiss())
if hasattr(os, "register_at_fork"):  # a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=_restart)
