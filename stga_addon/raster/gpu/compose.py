"""Several sets of splats in one picture on a GPU; the counterpart of `cpu.compose`."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from ...capture.camera import Camera
from ...errors import DeviceError
from ..cpu.compose import layer_frames
from ..cpu.layout import CameraFrames, Parameters
from ..posed_splats import ComposedImage, PosedSplats
from .device import Device, Recording
from .rasterize import (
    Rasterizer,
    SplatTable,
    Tables,
    ViewOptions,
    blend,
    make_projected,
    upload_frames,
    upload_splats,
)


def compose(
    adapter: str, layers: Sequence[PosedSplats], camera: Camera, with_depth: bool = False
) -> ComposedImage:
    """Render layers with a camera on the adapter of that name; see `cpu.compose.compose`.

    Raises DeviceError where the adapter fails.
    """
    try:
        return _compose(_rasterizer(adapter), layers, camera, with_depth)
    except DeviceError:
        _rasterizer.cache_clear()
        raise


@cache
def _rasterizer(adapter: str) -> Rasterizer:
    return Rasterizer(Device(adapter))


def _compose(
    rasterizer: Rasterizer, layers: Sequence[PosedSplats], camera: Camera, with_depth: bool
) -> ComposedImage:
    """Each layer has its own view of the same camera, and all share the tables of projected
    splats."""
    device = rasterizer.device
    given = list[tuple[PosedSplats, SplatTable, CameraFrames, Tables]]()
    for n, layer in enumerate(layers):
        frames = layer_frames(layer, camera)
        parameters = Parameters(*(getattr(layer.splats, name) for name in Parameters._fields))
        table = upload_splats(device, parameters, layer.splats.face, f" {n}")
        tables = {"splats": table.rows, "face": table.face}
        tables["frames"] = upload_frames(device, frames, f" {n}")
        given.append((layer, table, frames, tables))
    count = sum(table.count for _, table, _, _ in given)

    make_projected(device, count)

    def project(work: Recording, depth_as_color: bool = False) -> None:
        first = 0
        for n, (layer, table, frames, tables) in enumerate(given):
            options = ViewOptions(
                camera,
                layer.splats.sh_degree,
                depth_as_color=depth_as_color,
                antialiased=layer.antialiased,
            )
            view = rasterizer.upload_view(table, options, frames.to_world, first, f"view {n}")
            work.dispatch("project.forward", table.count, tables | {"view": view})
            first += table.count

    def render() -> Tables:
        """The colors, of all layers together; submitted."""
        view = rasterizer.upload_view(SplatTable(None, None, count, 0), ViewOptions(camera, 0))
        with device.record() as work:
            project(work)
            return rasterizer.draw(work, view, count, camera)

    rendering = render()
    while not rasterizer.pairs_fit():
        rendering = render()
    alpha = 1 - device.read(rendering["pixels"], (camera.height, camera.width, 2))[..., 0]
    rgb = device.read(rendering["image"], (3, camera.height, camera.width))
    if not with_depth:
        return ComposedImage(rgb, alpha, None)
    with device.record() as work:
        project(work, depth_as_color=True)
        blend(work, camera, rendering)
    depth = device.read(rendering["image"], (camera.height, camera.width))
    return ComposedImage(rgb, alpha, depth / np.maximum(alpha, np.finfo(np.float32).tiny))
