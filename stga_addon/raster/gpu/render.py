"""Rendering of splats on a GPU; the counterpart of the CPU's in `raster.render`."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from ...avatar.embedding import FaceFrames
from ...avatar.splats import Splats
from ...capture.camera import Camera
from ..cpu.layout import Parameters
from ..cpu.rasterize import frames_in_camera
from .device import Device
from .rasterize import Rasterizer, ViewOptions, upload_frames, upload_splats


def render_image(
    adapter: str, splats: Splats, camera: Camera, background: Sequence[float], frames: FaceFrames, antialiased: bool
) -> np.ndarray:
    """(3, H, W) float32 on the adapter of that name; see `raster.render.render`."""
    rasterizer = _rasterizer(adapter)
    device, camera_frames = rasterizer.device, frames_in_camera(frames, camera)
    parameters = Parameters(*(getattr(splats, name) for name in Parameters._fields))
    options = ViewOptions(
        camera, splats.sh_degree, background, camera_frames.strain.shape[1], antialiased=antialiased
    )  # fmt: skip
    while True:
        table, on_device = upload_splats(device, parameters, splats.face), upload_frames(device, camera_frames)
        with device.record() as work:
            view = rasterizer.upload_view(table, options)
            rendering = rasterizer.forward(work, table, on_device, options, view)
        if rasterizer.pairs_fit():
            return device.read(rendering.image, (3, camera.height, camera.width))


@cache
def _rasterizer(adapter: str) -> Rasterizer:
    return Rasterizer(Device(adapter))
