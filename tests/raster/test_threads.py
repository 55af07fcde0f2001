"""Kernels on Python's threads: every unit once, errors told, several callers at a time, the lock let go."""

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("numba")

from stga_addon.raster.cpu import jit
from stga_addon.raster.cpu.threads import next_piece, parallel, set_threads, threads

from .test_kernels import SCENES, kernel_gradients, random_cotangents


@pytest.fixture(autouse=True)
def as_many_as_before() -> Iterator[None]:
    before = threads()
    yield
    set_threads(before)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 20])
@pytest.mark.parametrize("units", [0, 1, 2, 5, 8, 100])
@pytest.mark.parametrize("piece", [1, 6])
def test_every_unit_is_done_once(count: int, units: int, piece: int) -> None:
    """Catches pieces that overlap, are left out at the end, or are taken by two threads."""

    @parallel(len, piece=piece)
    def count_up(work: np.ndarray, done: np.ndarray) -> None:
        begin, end = next_piece(work)
        while begin < end:
            done[begin:end] += 1
            begin, end = next_piece(work)

    set_threads(count)
    done = np.zeros(units, int)
    for _ in range(20):
        count_up(done)
    assert (done == 20).all()


@parallel(len)
@jit
def count_pieces(work, done):
    begin, end = next_piece(work)
    while begin < end:
        for n in range(begin, end):
            done[n] += 1
        begin, end = next_piece(work)


def test_threads_that_run_at_once_take_different_pieces() -> None:
    """Catches a counter that two threads read before either has advanced it: pieces this short collide at once."""
    set_threads(4)
    done = np.zeros(2_000_000, np.int64)
    for _ in range(5):
        count_pieces(done)
    assert (done == 5).all()


@pytest.mark.parametrize("at", [0, 9])
def test_an_error_reaches_the_caller(at: int) -> None:
    """Catches an error that dies with its thread, a caller that then waits for ever, and threads lost to it."""

    @parallel(len)
    def fail(work: np.ndarray, numbers: np.ndarray) -> None:
        begin, end = next_piece(work)
        while begin < end:
            if begin <= at < end:
                raise ValueError("this piece")
            begin, end = next_piece(work)

    set_threads(3)
    for _ in range(5):
        with pytest.raises(ValueError, match="this piece"):
            fail(np.zeros(10))


def test_several_callers_at_a_time() -> None:
    """Catches shared state between calls: Blender draws a viewport in a thread of its own while another one renders."""
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
    """Catches kernels that hold Python's lock: Blender's window would stand still while a picture is rendered."""
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
