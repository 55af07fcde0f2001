"""Bytes that training takes per splat, pixel and pair: the GPU's buffers against the CPU's arrays,
as documented."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from avatar.conftest import splats_of

from stga_addon.raster.gpu import rasterize
from stga_addon.raster.gpu.device import Device
from stga_addon.training.optimize.cpu_backend import CpuBackend
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.optimize.gpu_backend import GpuBackend
from stga_addon.training.optimize.state import arrays_of, new_state

from .test_gpu_backend import batch_of
from .test_trainer import view_of
from .toys import quick_settings

pytestmark = pytest.mark.needs("adapter")

SETTINGS = quick_settings("global", scale_limit=0.2)


def splats_on(capture, count, log_scale):
    """Splats of SH degree 3 on the first triangles."""
    face = np.arange(count) % len(capture.faces)
    sh = np.zeros((1, 16, 3))
    return splats_of(np.zeros((count, 3)), log_scale=log_scale, sh=sh, face=face)


def blank(capture, width, height):
    """A batch of a blank image."""
    view = view_of(capture, 1)
    view = replace(view, camera=replace(view.camera, width=width, height=height))
    target = np.zeros((height, width, 3), np.uint8)
    mask = np.zeros((height, width), np.uint8)
    for array in (target, mask):
        array.setflags(write=False)
    return batch_of(capture, SETTINGS, view=view, target=target, mask=mask)


def cpu_bytes(capture, count, size, log_scale):
    """Counts of splats, pixels and pairs (here found; room for them on the GPU), and bytes of the
    state and of the buffers that iterations share; without what a kernel allocates for itself."""
    state = new_state(splats_on(capture, count, log_scale))
    frames = FrameStore(capture, SETTINGS.convention)
    backend = CpuBackend(SETTINGS, frames, state)
    backend.step(blank(capture, *size))
    buffers = backend._buffers._buffers
    arrays = [*arrays_of(backend.state).values(), *buffers.values()]
    pairs = buffers["pair_blocks"].size * 8 // 9  # an eighth to spare
    return (count, size[0] * size[1], pairs), sum(array.nbytes for array in arrays)


def gpu_bytes(capture, count, size, capacity):
    rasterize.INITIAL_PAIR_CAPACITY = capacity
    device = Device()
    frames = FrameStore(capture, SETTINGS.convention)
    state = new_state(splats_on(capture, count, -9.0))
    backend = GpuBackend(device, SETTINGS, frames, state)
    backend.step(blank(capture, *size))
    assert len(backend.state) == count
    assert backend._rasterizer.capacity == capacity
    return (count, size[0] * size[1], capacity), device.bytes


def per_item(measured):
    """Bytes a splat, a pixel and a pair, from four measurements: the rest is constant."""
    counts = np.array([[*found, 1] for found, _ in measured], np.float64)
    return np.linalg.solve(counts, [size for _, size in measured])[:3]


@pytest.mark.nightly
def test_memory_is_the_cpus_and_as_documented(toy, monkeypatch):
    """Catches a table added to the GPU's iterations, and figures in the documentation that no
    longer hold."""
    monkeypatch.setattr(rasterize, "INITIAL_PAIR_CAPACITY", 1)  # restored at the end
    small = (320, 160)
    wide = (640, 160)
    sizes = (4096, small), (8192, small), (4096, wide)
    on_cpu = [cpu_bytes(toy, *size, -1.0) for size in sizes]
    on_cpu = per_item([*on_cpu, cpu_bytes(toy, 4096, small, 1.0)])
    on_gpu = [gpu_bytes(toy, *size, 1 << 16) for size in sizes]
    on_gpu = per_item([*on_gpu, gpu_bytes(toy, 4096, small, 1 << 17)])
    text = (Path(__file__).parents[2] / "docs/benchmarks.md").read_text(encoding="utf-8")
    rows = [
        re.search(rf"\ba\s{name} (\d[\d,]*) and (\d[\d,]*\d)", text)
        for name in ("splat", "pixel", "pair")
    ]
    documented = np.array(
        [[float(figure.replace(",", "")) for figure in row.groups()] for row in rows if row]
    )
    np.testing.assert_allclose(np.stack([on_cpu, on_gpu], 1), documented, rtol=0.02, atol=0.6)
    assert (np.abs(on_gpu / on_cpu - 1) < 0.4).all()
