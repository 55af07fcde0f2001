"""What an iteration costs a GPU, kernel by kernel: the part of `iteration.py --device gpu`."""

import statistics
from collections import Counter
from dataclasses import replace
from time import perf_counter, thread_time
from typing import Any

import numpy as np
import wgpu
from wgpu.backends.wgpu_native import lib

from stga_addon.raster.cpu.layout import PROJECTED
from stga_addon.raster.cpu.rasterize import tile_grid
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import COUNTS, DIGIT_BITS, NEEDED
from stga_addon.raster.gpu.rasterize import counts_buffer
from stga_addon.training.optimize.backend import Batch
from stga_addon.training.optimize.gpu_backend import GpuBackend

COPIED_BYTES, COPIES = 1 << 26, 8
SPLAT_WORDS = 59
"""Words of a splat of SH degree 3."""

MAX_DISPATCHES = 2048
"""Dispatches that are timed between two readings; later ones are not."""
_PER_RESOLVE = 32
"""Stamps copied at a time: their places in the buffer are multiples of 256 bytes."""


class KernelTimes:
    """Times what is recorded for a device while this is its `kernel_times`, each dispatch in a pass
    of its own."""

    def __init__(self, gpu: Any) -> None:
        """gpu: `Device.gpu`. Raises ValueError where the adapter has no timestamps."""
        if "timestamp-query" not in gpu.features:
            raise ValueError(f"{gpu.adapter.info['device']} has no timestamp queries")
        self._gpu, self._names = gpu, list[str]()
        self._resolved = 0
        self._queries = gpu.create_query_set(type="timestamp", count=2 * MAX_DISPATCHES)
        usage = wgpu.BufferUsage.QUERY_RESOLVE | wgpu.BufferUsage.COPY_SRC
        self._stamps = gpu.create_buffer(size=16 * MAX_DISPATCHES, usage=usage)
        self._period_ns = float(lib.wgpuQueueGetTimestampPeriod(gpu.queue._internal))

    def writes(self, name: str) -> dict[str, Any] | None:
        """The `timestamp_writes` of the pass that the next dispatch is alone in."""
        first = 2 * len(self._names)
        if first == 2 * MAX_DISPATCHES:
            return None
        self._names.append(name)
        indices = {"beginning_of_pass_write_index": first, "end_of_pass_write_index": first + 1}
        return {"query_set": self._queries, **indices}

    def resolve(self, encoder: Any) -> None:
        """Record that the stamps written since the last call are copied where `read` finds them."""
        end = 2 * len(self._names)
        for start in range(2 * self._resolved // _PER_RESOLVE * _PER_RESOLVE, end, _PER_RESOLVE):
            count = min(_PER_RESOLVE, end - start)
            encoder.resolve_query_set(self._queries, start, count, self._stamps, 8 * start)
        self._resolved = len(self._names)

    def read(self) -> dict[str, float]:
        """kernel -> milliseconds since the last call, after all submitted work, longest first."""
        total: Counter[str] = Counter()
        if self._names:
            data = self._gpu.queue.read_buffer(self._stamps, 0, 16 * len(self._names))
            stamps = np.frombuffer(data, np.uint64).reshape(-1, 2)
            for name, (begin, end) in zip(self._names, stamps.tolist(), strict=True):
                total[name] += 1e-6 * self._period_ns * max(end - begin, 0)
        self._names.clear()
        self._resolved = 0
        return dict(total.most_common())


def wait(device: Device) -> None:
    """Until all submitted work is done."""
    device.read(counts_buffer(device), (1,), np.uint32)


def queued_ms(backend: GpuBackend, repeats: int, batch: Batch) -> float:
    """Mean wall time in milliseconds of iterations that follow each other without waiting, after
    five of them."""
    for count in (5, repeats):
        wait(backend.device)
        begin = perf_counter()
        for _ in range(count):
            backend.step(batch)
        wait(backend.device)
    return 1e3 * (perf_counter() - begin) / repeats


def host_ms(backend: GpuBackend, batch: Batch, repeats: int) -> tuple[float, float]:
    """Median CPU time in milliseconds that the host's thread takes for an iteration: without the
    submit, and in it.

    Of an idle device. Software Vulkan computes in the submit, so that only a tiny image shows what
    the latter costs.
    """
    queue, inside = backend.device.gpu.queue, 0.0
    submit = queue.submit

    def timed(commands: object) -> None:
        nonlocal inside
        begin = thread_time()
        submit(commands)
        inside = thread_time() - begin

    queue.submit = timed
    times = []
    for _ in range(repeats):
        wait(backend.device)
        begin = thread_time()
        backend.step(batch)
        times.append((thread_time() - begin - inside, inside))
    del queue.submit
    recording, submitting = (1e3 * statistics.median(column) for column in zip(*times, strict=True))
    return recording, submitting


def tiny(batch: Batch) -> Batch:
    """The same view as an image of 16 × 16 pixels."""
    camera = replace(batch.view.camera, width=16, height=16)
    return replace(
        batch, view=replace(batch.view, camera=camera), target=batch.target[:16, :16].copy()
    )


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
    """kernel -> bytes that it must move at least in a global iteration; kernels without large
    arrays are left out."""
    row, projected = 4 * SPLAT_WORDS, 4 * PROJECTED
    sorted_keys = splats * -(-32 // DIGIT_BITS) + pairs * -(-tiles.bit_length() // DIGIT_BITS)
    return {
        "project.forward": splats * (row + projected + 24),
        "sort.count": 4 * sorted_keys,
        "sort.scatter": 16 * sorted_keys,
        "tiles.count_pairs": splats * 24,
        "tiles.fill_pairs": splats * 36 + pairs * 8,
        "tiles.find_ranges": pairs * 4,
        "blend.forward": pairs * (8 + projected) + pixels * 20,
        "image_loss.gradient": pixels * 27,
        "blend.backward": pairs * (8 + 2 * projected) + pixels * 20,
        "project.backward": pairs * projected + splats * (2 * row + projected + 16),
        "optimizer.measure_excess": splats * 40,
        "optimizer.prepare": splats * (row + 40),
        "optimizer.adam": splats * (9 * row + 20),
    }


def kernel_table(backend: GpuBackend, batch: Batch, repeats: int) -> dict[str, float]:
    """Print each kernel's time beside its floor, and what an iteration asks of the host; returns
    milliseconds."""
    device, camera = backend.device, batch.view.camera
    if device.is_software:
        print("This adapter is a CPU: its times say nothing of a GPU's")
    backend.step(batch)
    before = device.dispatches, device.submits, device.waits
    for _ in range(repeats):
        backend.step(batch)
    after = device.dispatches, device.submits, device.waits
    counts = [(b - a) / repeats for a, b in zip(before, after, strict=True)]
    print("{:g} dispatches, {:g} submits, {:g} waits an iteration".format(*counts))
    recording, submitting = host_ms(backend, batch, repeats)
    print(
        f"host thread: {recording:.2f} ms of CPU time to upload and record an iteration; {submitting:.2f} in the submit"
    )
    _, submitting = host_ms(backend, tiny(batch), repeats)
    print(
        f"of an image of 16 × 16 pixels, which leaves next to nothing to compute: {submitting:.2f} ms in the submit"
    )
    print(f"buffers: {device.bytes / 2**20:.0f} MiB")
    backend.step(batch)
    wait(device)
    pairs = int(device.read(counts_buffer(device), (COUNTS,), np.uint32)[NEEDED])
    bandwidth = copy_bandwidth(device)
    print(f"{pairs} pairs, copy {bandwidth / 1e9:.1f} GB/s")
    if "timestamp-query" not in device.gpu.features:
        print("No times of kernels: the adapter has no timestamps")
        return {}
    device.kernel_times = KernelTimes(device.gpu)
    for _ in range(repeats):
        backend.step(batch)
    found = {name: ms / repeats for name, ms in device.kernel_times.read().items()}
    device.kernel_times = None
    tiles_x, tiles_y = tile_grid(camera.width, camera.height)
    moved = least_bytes(len(backend), camera.width * camera.height, tiles_x * tiles_y, pairs)
    print(f"{'kernel':<26}{'ms':>8}{'MB':>8}{'floor ms':>10}{'ratio':>7}")
    for name, ms in found.items():
        floor = 1e3 * moved.get(name, 0) / bandwidth
        more = f"{moved[name] / 1e6:8.1f}{floor:10.2f}{ms / floor:7.1f}" if floor else ""
        print(f"{name:<26}{ms:8.3f}{more}")
    return found
