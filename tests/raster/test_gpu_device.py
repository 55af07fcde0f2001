"""The WebGPU device: buffers, uploads, dispatches and what is said when something fails."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusal import refusal

from raster import gpu_device
from stga_addon.raster.gpu import device as device_module
from stga_addon.raster.gpu.adapters import adapters
from stga_addon.raster.gpu.device import Device, Readback

pytestmark = pytest.mark.needs("adapter")

NUMBERS = """
var<storage> numbers: array<u32>;
@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let n = thread_number(thread);
  if n < arrayLength(&numbers) { numbers[n] += n; }
}
"""


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.int32])
@pytest.mark.parametrize("count", [1, 3, 4, 1021])
def test_arrays_arrive_whole(device, dtype, count):
    """Catches the last bytes of an image that is no multiple of a word left behind."""
    values = (np.arange(count) * 7 % 251).astype(dtype)
    buffer = device.upload(f"values {np.dtype(dtype)}", values)
    assert_array_equal(device.read(buffer, values.shape, dtype), values)


def test_every_thread_of_a_long_dispatch_runs_once(device, monkeypatch):
    """Catches threads beyond the longest row of workgroups that are lost or run twice, and a
    dispatch that would read what another one bound."""
    source = device_module._source
    monkeypatch.setattr(
        device_module, "_source", lambda name: NUMBERS if name == "numbers" else source(name)
    )
    monkeypatch.setattr(device_module, "MAX_GROUPS", 7)
    count = 100 * 256 + 10
    assert device.groups_of(count // 256)[1] > 10
    buffer = device.buffer("many", count)
    with device.record() as work:
        work.clear(buffer)
        work.dispatch("numbers.main", count, {"numbers": buffer})
    expected = np.arange(count, dtype=np.uint32)
    assert_array_equal(device.read(buffer, (count,), np.uint32), expected)
    with pytest.raises(KeyError, match="numbers"):
        device.record().dispatch("numbers.main", (1, 1, 1), {"others": buffer})


def test_a_buffer_grows_and_begins_with_zeros(device):
    """Catches a buffer that is too small, and a new one at every request."""
    small = device.buffer("growing", 100)
    assert device.buffer("growing", 50) is small
    large = device.buffer("growing", 200)
    assert large.size >= 4 * 225
    assert device.buffer("growing", 220) is large
    assert not device.read(large, (200,)).any()


def test_what_the_user_is_told(device):
    """Catches a traceback of the driver's instead of a sentence."""
    with refusal(r"no such adapter; there are: .*\("):
        Device("Voodoo 2")
    with refusal(r"allows buffers of \d+ MiB .* for rows"):
        device.buffer("rows", device.max_bytes)
    with refusal(r"memory of .* is full"), device.errors():
        raise gpu_device.wgpu.GPUOutOfMemoryError("")
    with refusal(r"was lost .*--device cpu.* --resume"), device.errors():
        raise gpu_device.wgpu.GPUValidationError("Parent device is lost")


def test_a_lost_device_is_told_to_who_waits(device, monkeypatch):
    """Catches a run that waits for ever for a driver that was reset."""
    readback = Readback(device, 4)
    words = device.upload("words", np.zeros(4, np.uint32))

    def lost(*_):
        raise gpu_device.wgpu.GPUError("Parent device is lost")

    with monkeypatch.context() as broken:
        broken.setattr(type(device.gpu), "_poll", lost)
        broken.setattr(device_module, "LOST_CHECK_S", 0.05)
        with device.record() as work:
            readback.copy_from(work, (words, 4))
        readback.start()
        with refusal(r"was lost .*--device cpu.* --resume"):
            readback.result()
    assert readback._promise._thread_event.wait(10)
    device.failures.clear()


def test_adapters_have_names_of_their_own():
    """Catches two equal cards of which only one can be chosen."""
    assert len(adapters()) == len(set(adapters()))
    assert all(name.strip() for name in adapters())
