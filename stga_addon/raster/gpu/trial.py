"""Trial: whether a device's gradients are the CPU's, and which of the two is faster, before
training on it."""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ...avatar.embedding import WORLD
from ...capture.camera import Camera
from ..cpu.layout import Parameters
from ..cpu.rasterize import BufferPool, frames_in_camera, render_backward, render_forward
from .device import Device
from .layout import splat_rows
from .rasterize import Rasterizer, ViewOptions, upload_frames, upload_splats

SIZE = 20_000, 400
"""Splats, and pixels of a side of the image."""
SOFTWARE_SIZE = 1_000, 80
"""The same for adapters that compute on the CPU, whose speed is known to be low."""
DEGREE = 1
"""Degree of the trial's spherical harmonics."""
MAX_ERROR = 1e-3
"""Error of a wrong device's gradient, as a fraction of the gradient's length; rounding makes 1e-5
of it, a lost pair 1e-2."""
SECONDS = 0.3
"""Time for each of the two, after the first image, which is not timed."""


@dataclass(frozen=True)
class Trial:
    """error: largest difference of a parameter's gradient from the CPU's, as a fraction of its
    length; times in s."""

    error: float
    device_s: float
    cpu_s: float

    @property
    def is_right(self) -> bool:
        return self.error <= MAX_ERROR  # not where it is NaN


def try_device(device: Device) -> Trial:
    """Render a cloud of splats and differentiate a random sum of its colors, on the device and on
    the CPU."""
    count, size = SOFTWARE_SIZE if device.is_software else SIZE
    random = np.random.default_rng(0)
    middle = size / 2
    values = (
        random.normal(size=(count, 3)) * 0.4 + (0, 0, 2),
        random.normal(size=(count, 4)),
        random.normal(size=(count, 3)) * 0.4 - 4.5,
        random.normal(size=count),
        random.normal(size=(count, (DEGREE + 1) ** 2, 3)) * 0.4,
    )
    splats = Parameters(*(value.astype(np.float32) for value in values))
    camera = Camera(size, size, 1.25 * size, 1.25 * size, middle, middle, np.eye(4))
    face = np.zeros(count, np.int32)
    frames = frames_in_camera(WORLD, camera)
    v_image = np.random.default_rng(1).normal(size=(3, size, size)).astype(np.float32)
    gradients = Parameters(*map(np.zeros_like, splats))
    buffers = BufferPool()

    def on_cpu() -> None:
        output = render_forward(splats, face, frames, DEGREE, buffers=buffers)
        render_backward(output, splats, face, frames, v_image, gradients, buffers=buffers)

    rasterizer = Rasterizer(device)
    table = upload_splats(device, splats, face)
    on_device = upload_frames(device, frames)
    cotangents = device.upload("v_image", v_image)
    found = device.buffer("gradients", count * table.stride)
    options = ViewOptions(camera, DEGREE)

    def on_gpu() -> None:
        view = rasterizer.upload_view(table, options)
        with device.record() as work:
            rendering = rasterizer.forward(work, table, on_device, options, view)
            rasterizer.backward(work, rendering, table, camera, cotangents, found)

    on_cpu()
    cpu_s = _seconds_of(on_cpu, lambda: True, 1)
    expected = splat_rows(gradients)
    on_gpu()
    while not rasterizer.pairs_fit():
        on_gpu()
    device_s = _seconds_of(on_gpu, rasterizer.pairs_fit, 4)
    lengths = np.linalg.norm(expected, axis=0)
    got = device.read(found, (count, table.stride))
    errors = np.linalg.norm(got - expected, axis=0)[lengths > 0] / lengths[lengths > 0]
    return Trial(float(errors.max()), device_s, cpu_s)


def _seconds_of(once: Callable[[], None], wait: Callable[[], bool], ahead: int) -> float:
    """Seconds of one image; ahead: how many images the host may be ahead of the device, as in
    training."""
    count = 0
    began = perf_counter()
    while not count or perf_counter() - began < SECONDS:
        for _ in range(ahead):
            once()
        wait()
        count += ahead
    return (perf_counter() - began) / count
