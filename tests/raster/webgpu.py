"""The WebGPU device of the tests: any adapter, software Vulkan where there is no GPU."""

import pytest

wgpu = pytest.importorskip("wgpu")

from stga_addon.raster.webgpu.device import Device, adapters  # noqa: E402


def device() -> Device:
    """A device of the first adapter; skips the test where there is none."""
    if not adapters():
        pytest.skip("no WebGPU adapter (Debian's software Vulkan: mesa-vulkan-drivers)")
    return Device()
