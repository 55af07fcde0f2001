"""Kernels on Python's threads: every unit once, errors told, several callers at a time, the lock
let go."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from numba import types
from numba.extending import intrinsic
from numpy.testing import assert_array_equal, assert_equal

from stga_addon.raster.cpu import jit
from stga_addon.raster.cpu import threads as kernel_threads
from stga_addon.raster.cpu.elementary import fetch_add, latest, yield_processor
from stga_addon.raster.cpu.threads import (
    call_helpers,
    end_stages,
    parallel,
    pieces,
    set_threads,
    stage,
    threads,
)

from .test_kernels import SCENES, kernel_gradients, random_cotangents


@pytest.fixture(autouse=True)
def as_many_as_before():
    before = threads()
    yield
    set_threads(before)


def count_up(work, done):
    call_helpers(work)
    for begin, end in pieces(work):
        for n in range(begin, end):
            done[n] += 1


@pytest.mark.parametrize("count", [1, 2, 3, 7, 20])
@pytest.mark.parametrize("piece", [1, 6])
def test_every_unit_is_done_once(count, piece):
    """Catches pieces that overlap, are left out at the end, or are taken by two threads that read
    the counter before either has advanced it: pieces this short collide at once."""
    set_threads(count)
    call = parallel(len, piece=piece)(count_up)
    for units in (0, 1, 2, 5, 8, 100, 1_000_000):
        done = np.zeros(units, np.int64)
        for _ in range(10):
            call(done)
        assert (done == 10).all()


@intrinsic
def is_counted(typing, array):
    def generate(context, builder, signature, arguments):
        owner = context.make_array(signature.args[0])(context, builder, arguments[0]).meminfo
        return builder.icmp_unsigned("!=", owner, owner.type(None))

    return types.boolean(array), generate


@parallel(lambda *_: 2)
def look_at_counts(work, begun, counted):
    call_helpers(work)
    for n, _ in pieces(work):
        fetch_add(begun, 0, 1)
        while latest(begun, 0) < 2:  # so that the helper does one of the two
            yield_processor()
        counted[n] = is_counted(counted)


def test_helpers_count_no_references():
    """Catches cores that take the counts of the same arrays' references from each other, a dozen
    times for every block of rows."""
    set_threads(2)
    counted = np.zeros(2, bool)
    look_at_counts(np.zeros(1, np.int64), counted)
    assert sorted(counted) == [False, True]


@parallel(lambda numbers, *_: len(numbers))
def fail(work, numbers, at):
    call_helpers(work)
    for begin, end in pieces(work):
        if begin <= at < end:
            raise ValueError("this piece")


@parallel(lambda numbers, *_: len(numbers))
def fail_in_a_stage(work, numbers, at):
    call_helpers(work)
    for n in stage(work, 0, len(numbers)):
        if n == at:
            raise ValueError("this piece")
    for n in stage(work, 1, len(numbers)):
        numbers[n] += 1
    end_stages(work)


@parallel(lambda sums, *_: sums.shape[1], piece=2)
def add_neighbors(work, sums):
    call_helpers(work)
    for s in range(1, sums.shape[0]):
        for n in stage(work, s - 1, sums.shape[1]):
            sums[s, n] = sums[s - 1, n - 1] + sums[s - 1, (n + 1) % sums.shape[1]]
    end_stages(work)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_a_stage_begins_when_the_one_before_is_done(count):
    """Catches a thread that goes on while another one is still in the stage before."""
    set_threads(count)
    for length in (2, 5, 1000):
        sums = np.zeros((13, length), np.int64)
        sums[0] = np.arange(length)
        expected = sums[0]
        for _ in range(12):
            expected = np.roll(expected, 1) + np.roll(expected, -1)
        for _ in range(20):
            sums[1:] = 0
            add_neighbors(sums)
            assert_array_equal(sums[-1], expected)


@pytest.mark.parametrize("fail", [fail, fail_in_a_stage])
@pytest.mark.parametrize("at", [0, 9])
def test_an_error_reaches_the_caller(fail, at):
    """Catches an error that dies with its thread, a caller that then waits for ever, and threads
    lost to it, or that never come: all is done, but by the caller alone."""
    set_threads(3)
    for _ in range(5):
        with pytest.raises(ValueError, match="this piece"):
            fail(np.zeros(10), at)
    fail(np.zeros(10), 10)
    met = np.zeros(4, np.int64)
    meet(met, 100_000_000)  # some seconds
    assert (met == 3).all()


@parallel(lambda met, *_: len(met) - 1)
def meet(work, met, patience):
    call_helpers(work)
    for begin, _ in pieces(work):
        fetch_add(met, 0, 1)
        for _ in range(patience):
            if fetch_add(met, 0, 0) == len(met) - 1:
                break
        met[1 + begin] = fetch_add(met, 0, 0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_has_threads_of_its_own():
    """Catches a child that gives its kernels to its parent's threads, or waits for the lock that
    one of them held."""
    set_threads(3)
    meet(np.zeros(4, np.int64), 100_000_000)
    child = os.fork()
    if child == 0:
        met = np.zeros(4, np.int64)
        meet(met, 100_000_000)
        os._exit(0 if (met == 3).all() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_several_callers_at_a_time():
    """Catches shared state between calls: Blender draws a viewport in a thread of its own while
    another one renders."""
    scene = SCENES["plain"]
    cotangents = random_cotangents(scene.camera)
    _, expected = kernel_gradients(scene, cotangents)
    found = []

    def render():
        for _ in range(5):
            found.append(kernel_gradients(scene, cotangents)[1])

    set_threads(2)
    callers = [threading.Thread(target=render) for _ in range(3)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(found) == 15
    for gradients in found:
        assert_equal(expected, gradients)


def test_the_thread_count_changes_meanwhile():
    """Catches helpers that end in the middle of a kernel, and a caller that waits for them."""
    ended = threading.Event()

    def change():
        while not ended.is_set():
            for count in (3, 1, 7):
                set_threads(count)

    other = threading.Thread(target=change)
    other.start()
    call = parallel(len, piece=64)(count_up)
    try:
        for _ in range(100):
            done = np.zeros(10_000, np.int64)
            call(done)
            assert (done == 1).all()
    finally:
        ended.set()
        other.join()


def test_helpers_sleep_between_kernels():
    """Catches helpers that look for the next kernel for ever: a core each, also in Blender while
    nothing is rendered."""
    set_threads(7)
    meet(np.zeros(8, np.int64), 100_000_000)
    time.sleep(0.1)
    before = time.process_time()
    time.sleep(0.5)
    assert time.process_time() - before < 0.1


def until_interrupted(call):
    while True:
        call(np.zeros(10_000, np.int64))


@pytest.mark.skipif(os.name != "posix", reason="no signals")
def test_an_interrupt_leaves_the_threads_usable():
    """Catches Ctrl-C that is not noticed while kernels run, or leaves helpers in one for ever."""
    set_threads(3)
    meet(np.zeros(4, np.int64), 100_000_000)
    call = parallel(len, piece=64)(count_up)
    for _ in range(10):
        timer = threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            until_interrupted(call)
        timer.join()
    met = np.zeros(4, np.int64)
    meet(met, 100_000_000)
    assert (met == 3).all()


def test_an_interrupt_as_helpers_are_taken_gives_them_back(monkeypatch):
    """Catches a Ctrl-C after which all kernels run on one thread, for ever."""
    set_threads(3)
    pool = kernel_threads._pool
    lock = pool._busy

    class Interrupted:
        release = lock.release

        def acquire(self, blocking):
            assert lock.acquire(blocking)
            raise KeyboardInterrupt

    monkeypatch.setattr(pool, "_busy", Interrupted())
    with pytest.raises(KeyboardInterrupt):
        meet(np.zeros(4, np.int64), 1)
    monkeypatch.setattr(pool, "_busy", lock)
    taken = []
    other = threading.Thread(target=lambda: taken.append(lock.acquire(blocking=False)))
    other.start()
    other.join()
    assert taken == [True]


@jit
def spin(times):
    x = 0.0
    for k in range(times):
        x += 1.0 / (1.0 + x * x + k)
    return x


def test_python_goes_on_meanwhile():
    """Catches kernels that hold Python's lock: Blender's window would stand still while a picture
    is rendered."""
    spin(1)
    ticks = []
    ended = threading.Event()

    def tick():
        while not ended.wait(0.001):
            ticks.append(time.monotonic())

    other = threading.Thread(target=tick)
    other.start()
    while not ticks:
        time.sleep(0.001)
    before = len(ticks)
    spin(100_000_000)  # some tenths of a second
    during = len(ticks) - before
    ended.set()
    other.join()
    assert during > 1
