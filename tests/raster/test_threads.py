"""Kernels on Python's threads: every unit once, errors told, several callers at a time, the lock
let go."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("numba")

from stga_addon.raster.cpu import jit
from stga_addon.raster.cpu.elementary import fetch_add, load, pause
from stga_addon.raster.cpu.threads import next_piece, parallel, set_threads, threads

from .test_kernels import SCENES, kernel_gradients, random_cotangents


@pytest.fixture(autouse=True)
def as_many_as_before() -> Iterator[None]:
    before = threads()
    yield
    set_threads(before)


@jit
def count_up(work, done):
    begin, end = next_piece(work)
    while begin < end:
        for n in range(begin, end):
            done[n] += 1
        begin, end = next_piece(work)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 20])
@pytest.mark.parametrize("units", [0, 1, 2, 5, 8, 100])
@pytest.mark.parametrize("piece", [1, 6])
def test_every_unit_is_done_once(count: int, units: int, piece: int) -> None:
    """Catches pieces that overlap, are left out at the end, or are taken by two threads."""
    set_threads(count)
    done = np.zeros(units, np.int64)
    call = parallel(len, piece=piece)(count_up)
    for _ in range(20):
        call(done)
    assert (done == 20).all()


def test_threads_that_run_at_once_take_different_pieces() -> None:
    """Catches a counter that two threads read before either has advanced it: pieces this short
    collide at once."""
    set_threads(4)
    done = np.zeros(2_000_000, np.int64)
    call = parallel(len)(count_up)
    for _ in range(5):
        call(done)
    assert (done == 5).all()


@parallel(lambda numbers, *_: len(numbers))
@jit
def fail(work, numbers, at):
    begin, end = next_piece(work)
    while begin < end:
        if begin <= at < end:
            raise ValueError("this piece")
        begin, end = next_piece(work)


@pytest.mark.parametrize("at", [0, 9])
def test_an_error_reaches_the_caller(at: int) -> None:
    """Catches an error that dies with its thread, a caller that then waits for ever, and threads
    lost to it."""
    set_threads(3)
    for _ in range(5):
        with pytest.raises(ValueError, match="this piece"):
            fail(np.zeros(10), at)
    fail(np.zeros(10), 10)


@parallel(lambda met, *_: len(met) - 1)
@jit
def meet(work, met, patience):
    begin, end = next_piece(work)
    while begin < end:
        fetch_add(met, 0, 1)
        for _ in range(patience):
            if load(met, 0) == len(met) - 1:
                break
            pause()
        met[1 + begin] = load(met, 0)
        begin, end = next_piece(work)


@pytest.mark.parametrize("rest", [0.0, 0.1])
def test_the_threads_work_at_once(rest: float) -> None:
    """Catches helpers that never come, after a rest in which they fell asleep as well: all is done,
    but by the caller alone."""
    set_threads(7)
    for _ in range(5):
        time.sleep(rest)
        met = np.zeros(8, np.int64)
        meet(met, 100_000_000)  # some seconds
        assert (met == 7).all()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_has_threads_of_its_own() -> None:
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


AT_EXIT = """
import numpy as np
from stga_addon.raster.cpu.image_loss import change_background
from stga_addon.raster.cpu.threads import set_threads
set_threads(8)
image, black = np.zeros((512, 64, 3), np.uint8), np.zeros(3, np.float32)
out = np.empty_like(image)
change_background(image, np.zeros((512, 64), np.uint8), black, np.full(3, 7, np.float32), out)
print(out.min())
"""


def test_a_process_ends_while_its_threads_look_for_work() -> None:
    """Catches threads that run on where Python has already freed their memory and code: a crash
    after the last line."""
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", AT_EXIT], capture_output=True, text=True, timeout=60
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, "7\n", "")


def test_several_callers_at_a_time() -> None:
    """Catches shared state between calls: Blender draws a viewport in a thread of its own while
    another one renders."""
    scene = SCENES["plain"]
    cotangents = random_cotangents(scene.camera)
    _, expected = kernel_gradients(scene, cotangents)
    found: list[dict[str, np.ndarray]] = []

    def render() -> None:
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
        for name, value in gradients.items():
            np.testing.assert_array_equal(value, expected[name], err_msg=name)


@jit
def spin(begin, end, times, out):
    for n in range(begin, end):
        x = 0.0
        for k in range(times):
            x += 1.0 / (1.0 + x * x + k)
        out[n] = x


def test_python_goes_on_meanwhile() -> None:
    """Catches kernels that hold Python's lock: Blender's window would stand still while a picture
    is rendered."""
    out = np.zeros(1)
    spin(0, 1, 1, out)
    ticks = []
    ended = threading.Event()

    def tick() -> None:
        while not ended.is_set():
            ticks.append(time.monotonic())
            time.sleep(0.001)

    other = threading.Thread(target=tick)
    other.start()
    while not ticks:
        time.sleep(0.001)
    before = len(ticks)
    spin(0, 1, 100_000_000, out)  # some tenths of a second
    during = len(ticks) - before
    ended.set()
    other.join()
    assert during > 1
