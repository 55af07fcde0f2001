"""Timestamps of kernels on a WebGPU device."""

from time import perf_counter

import numpy as np
import pytest

from raster import gpu_device
from stga_addon.raster.gpu import timing
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import VIEW
from stga_addon.raster.gpu.project import mark_focus
from stga_addon.raster.gpu.timing import KernelTimes

pytestmark = pytest.mark.needs("adapter")


@pytest.fixture(scope="module")
def device() -> Device:
    device = gpu_device.device()
    if "timestamp-query" not in device.gpu.features:
        pytest.skip(f"{device.name} has no timestamp queries")
    return device


def mark(device: Device, count: int, repeats: int) -> None:
    """Dispatch a kernel of `count` threads in one recording."""
    view = np.zeros(1, VIEW)
    view["splats"] = count
    given = {"view": device.upload("view", view, "uniform"), "face": device.upload("face", np.zeros(count, np.uint32))}
    with device.record() as work:
        for _ in range(repeats):
            mark_focus(work, count, selected=device.upload("selected", np.ones(1, np.uint32)), **given)


def test_every_dispatch_is_timed(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches stamps of another dispatch or recording, lost beyond the first, in another unit, or read twice."""
    monkeypatch.setattr(timing, "MAX_DISPATCHES", 90)
    count = 500_000
    mark(device, count, 1)
    device.kernel_times = times = KernelTimes(device.gpu)
    try:
        begin = perf_counter()
        for repeats in (1, 50, 7):
            mark(device, count, repeats)
        found = times.read()
        elapsed_ms = 1e3 * (perf_counter() - begin)
        assert list(found) == ["focus.main"]
        assert 0.2 * elapsed_ms < found["focus.main"] <= elapsed_ms
        assert times.read() == {}
        mark(device, 10, 1)
        assert 0 < times.read()["focus.main"] < found["focus.main"] / 20
        mark(device, 10, 100)  # more than there is room for
        assert times.read()["focus.main"] > 0
    finally:
        device.kernel_times = None
    mark(device, 10, 1)
    assert times.read() == {}
