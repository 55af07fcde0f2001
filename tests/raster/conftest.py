"""The device of tests marked `needs("adapter")`."""

import pytest


@pytest.fixture(scope="session")
def device():
    from raster import gpu_device

    return gpu_device.device()
