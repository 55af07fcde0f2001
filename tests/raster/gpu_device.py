"""The WebGPU device of the tests: any adapter, software Vulkan where there is no GPU."""

from functools import cache

import pytest

wgpu = pytest.importorskip("wgpu")

from stga_addon.raster.gpu.device import Device  # noqa: E402


@cache
def device():
    """The first adapter's device, whose kernels stay compiled, for tests marked
    `needs("adapter")`."""
    return Device()
