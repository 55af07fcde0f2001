"""The WebGPU device of the tests: any adapter, software Vulkan where there is no GPU."""

from functools import cache

import pytest

wgpu = pytest.importorskip("wgpu")

from stga_addon.raster.gpu.adapters import adapters  # noqa: E402
from stga_addon.raster.gpu.device import Device  # noqa: E402


def device() -> Device:
    """The first adapter's device, whose kernels stay compiled; skips the test where there is none."""
    if not adapters():
        pytest.skip("no WebGPU adapter (Debian's software Vulkan: mesa-vulkan-drivers)")
    return _device()


@cache
def _device() -> Device:
    return Device()
