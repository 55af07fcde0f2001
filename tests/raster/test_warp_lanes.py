"""What a GPU's warp does together, on 32 threads that go in step: Warp's CPU device, where every lane is a warp of its
own, never runs these lines.

The very text that goes into the kernels is compiled by g++, with the shuffles of CUDA made of a barrier.
"""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from stga_addon.raster.gpu import blend

THREADS, WARP_LANES = 64, 32
"""A block of the backward kernel is two warps."""
SOURCE = """
#include <algorithm>
#include <barrier>
#include <cstdlib>
#include <thread>
#include <vector>
#define __CUDA_ARCH__ 900
using std::max;

static thread_local struct { int x; } threadIdx;
static std::barrier<> in_step[2] = {std::barrier<>(32), std::barrier<>(32)};

template <class T> static T __shfl_xor_sync(unsigned mask, T value, int other) {
    static T held[64];
    if (mask != 0xffffffffu) abort();  // what is written for lanes that are left out is not what runs here
    std::barrier<> &warp = in_step[threadIdx.x / 32];
    held[threadIdx.x] = value;
    warp.arrive_and_wait();
    T result = held[threadIdx.x ^ other];
    warp.arrive_and_wait();
    return result;
}

static float over_warp(float value) { %s }
static int largest_of_warp(int value) { %s }
static bool leads() { %s }

template <class F> static void block(F lane) {
    std::vector<std::thread> threads;
    for (int n = 0; n < 64; n++) threads.emplace_back([=] { threadIdx.x = n; lane(n); });
    for (auto &thread : threads) thread.join();
}
extern "C" void sums(float *values) { block([=](int n) { values[n] = over_warp(values[n]); }); }
extern "C" void largest(int *values) { block([=](int n) { values[n] = largest_of_warp(values[n]); }); }
extern "C" void leading(int *values) { block([=](int n) { values[n] = leads(); }); }
"""


@pytest.fixture(scope="module")
def gpu(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The functions, each over a block: values in, values out in their place."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("there is no g++ to compile the functions of a warp with")
    folder: Path = tmp_path_factory.mktemp("lanes")
    functions = (blend._warp_sum, blend._warp_max, blend._is_warp_leader)
    (folder / "lanes.cpp").write_text(SOURCE % tuple(function.native_snippet for function in functions))
    command = [compiler, "-std=c++20", "-O1", "-shared", "-fPIC", "-pthread", "lanes.cpp", "-o", "lanes.so"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return ctypes.CDLL(str(folder / "lanes.so"))


def run(function: ctypes._CFuncPtr, values: np.ndarray) -> np.ndarray:
    """(2, WARP_LANES) by warp."""
    result = values.copy()
    function(result.ctypes.data_as(ctypes.c_void_p))
    return result.reshape(-1, WARP_LANES)


def blocks(count: int) -> list[np.ndarray]:
    """Random numbers, some of whose lanes have nothing to add; one lane alone has something; none has."""
    rng = np.random.default_rng(3)
    values = rng.normal(0, 100, (count, THREADS)) * (rng.random((count, THREADS)) < 0.7)
    alone = np.eye(THREADS)[[0, 31, 32, 63]] * 7
    return [*values, *alone, np.zeros(THREADS)]


def test_sums(gpu: ctypes.CDLL) -> None:
    """Catches a step of the sum that is left out or taken twice, and a sum over the other warp's lanes."""
    for values in blocks(20):
        found = run(gpu.sums, values.astype(np.float32))
        assert (found == found[:, :1]).all()  # the same bits in all lanes
        np.testing.assert_allclose(found[:, 0], values.reshape(-1, WARP_LANES).sum(1), rtol=1e-5, atol=1e-4)


def test_largest(gpu: ctypes.CDLL) -> None:
    """Catches a lane that is not looked at, whichever it is, and a zero that beats negative numbers."""
    for values in (*blocks(20), *(values - 1000 for values in blocks(3))):
        whole = values.astype(np.int32)
        found = run(gpu.largest, whole)
        np.testing.assert_array_equal(
            found, np.repeat(whole.reshape(-1, WARP_LANES).max(1), WARP_LANES).reshape(-1, WARP_LANES)
        )


def test_one_lane_leads_each_warp(gpu: ctypes.CDLL) -> None:
    """Catches a block in which one warp writes nothing, and rows that are written 32 times."""
    found = run(gpu.leading, np.full(THREADS, -1, np.int32))
    np.testing.assert_array_equal(found, np.eye(WARP_LANES, dtype=np.int32)[[0, 0]])
