"""What an iteration costs a GPU, kernel by kernel: the part of `iteration.py --device gpu`."""

import statistics
from collections.abc import Callable
from time import perf_counter

import numpy as np

from stga_addon.raster.cpu.layout import PROJECTED
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import COUNTS, DIGIT_BITS, NEEDED
from stga_addon.raster.gpu.tiles import counts_buffer
from stga_addon.raster.gpu.timing import KernelTimes

COPIED_BYTES, COPIES = 1 << 26, 8
SPLAT_WORDS = 59
"""Words of a splat of SH degree 3."""


def wait(device: Device) -> None:
    """Until all submitted work is done."""
    device.read(counts_buffer(device), (1,), np.uint32)


def queued_ms(device: Device, step: Callable[[], object], repeats: int) -> float:
    """Mean wall time in milliseconds of iterations that follow each other without waiting, after five of them."""
    for count in (5, repeats):
        wait(device)
        begin = perf_counter()
        for _ in range(count):
            step()
        wait(device)
    return 1e3 * (perf_counter() - begin) / repeats


def host_ms(device: Device, step: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median milliseconds that the host takes for an iteration of an idle device: uploads and recording, submit.

    Software Vulkan computes in the submit.
    """
    queue, inside = device.gpu.queue, 0.0
    submit = queue.submit

    def timed(commands: object) -> None:
        nonlocal inside
        begin = perf_counter()
        submit(commands)
        inside = perf_counter() - begin

    queue.submit = timed
    times = []
    for _ in range(repeats):
        wait(device)
        begin = perf_counter()
        step()
        times.append((perf_counter() - begin - inside, inside))
    del queue.submit
    recording, submitting = (1e3 * statistics.median(column) for column in zip(*times, strict=True))
    return recording, submitting


def copy_bandwidth(device: Device) -> float:
    """Bytes a second, read and written, of copies on the device."""
    source, target = (device.buffer(f"copied {n}", COPIED_BYTES // 4) for n in range(2))
    elapsed = 0.0
    for _ in range(2):  # the first touches the memory
        wait(device)
        begin = perf_counter()
        with device.record() as work:
            for _ in range(COPIES):
                work.copy(source, target, COPIED_BYTES // 4)
        wait(device)
        elapsed = perf_counter() - begin
    return 2 * COPIES * COPIED_BYTES / elapsed


def least_bytes(splats: int, pixels: int, tiles: int, pairs: int) -> dict[str, int]:
    """kernel -> bytes that it must move at least in a global iteration; kernels without large arrays are left out."""
    row, projected = 4 * SPLAT_WORDS, 4 * PROJECTED
    sorted_keys = splats * -(-32 // DIGIT_BITS) + pairs * -(-tiles.bit_length() // DIGIT_BITS)
    return {
        "project.main": splats * (row + projected + 24),
        "sort.count": 4 * sorted_keys,
        "sort.scatter": 16 * sorted_keys,
        "count_pairs.count": splats * 24,
        "fill_pairs.main": splats * 36 + pairs * 8,
        "tile_lists.main": pairs * 20,
        "blend_forward.main": pairs * (8 + projected) + pixels * 20,
        "image_loss.gradient": pixels * 27,
        "blend_backward.main": pairs * (8 + 2 * projected) + pixels * 20,
        "project_backward.main": pairs * projected + splats * (2 * row + projected + 16),
        "limits.measure": splats * 40,
        "rows.main": splats * (row + 40),
        "adam.main": splats * (9 * row + 20),
    }


def kernel_table(
    device: Device, step: Callable[[], object], splats: int, pixels: int, tiles: int, repeats: int
) -> dict[str, float]:
    """Print each kernel's time beside its floor, and what an iteration asks of the host; returns milliseconds."""
    before = device.dispatches, device.submits, device.waits
    for _ in range(repeats):
        step()
    after = device.dispatches, device.submits, device.waits
    counts = [(b - a) / repeats for a, b in zip(before, after, strict=True)]
    print("{:g} dispatches, {:g} submits, {:g} waits an iteration".format(*counts))
    recording, submitting = host_ms(device, step, repeats)
    print(f"host: {recording:.2f} ms an iteration and {submitting:.2f} in the submit")
    print(f"buffers: {device.bytes / 2**20:.0f} MiB")
    wait(device)
    pairs = int(device.read(counts_buffer(device), (COUNTS,), np.uint32)[NEEDED])
    bandwidth = copy_bandwidth(device)
    print(f"{pairs} pairs, copy {bandwidth / 1e9:.1f} GB/s")
    if "timestamp-query" not in device.gpu.features:
        print("No times of kernels: the adapter has no timestamps")
        return {}
    device.kernel_times = KernelTimes(device)
    for _ in range(repeats):
        step()
    found = {name: ms / repeats for name, ms in device.kernel_times.read().items()}
    device.kernel_times = None
    moved = least_bytes(splats, pixels, tiles, pairs)
    print(f"{'kernel':<26}{'ms':>8}{'MB':>8}{'floor ms':>10}{'ratio':>7}")
    for name, ms in found.items():
        floor = 1e3 * moved.get(name, 0) / bandwidth
        more = f"{moved[name] / 1e6:8.1f}{floor:10.2f}{ms / floor:7.1f}" if floor else ""
        print(f"{name:<26}{ms:8.3f}{more}")
    return found
