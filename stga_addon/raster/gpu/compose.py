"""Several sets of splats in one picture on a GPU; the counterpart of `cpu.compose`."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from ...capture.camera import Camera
from ...errors import DeviceError
from ..cpu.compose import layer_frames
from ..cpu.layout import CameraFrames, Parameters
from ..posed_splats import ComposedImage, PosedSplats
from .blend import blend_forward
from .device import Device, Recording
from .project import ProjectedSplats, project, projected_tables
from .rasterize import Rasterizer, Rendering, SplatTable, ViewOptions, upload_frames, upload_splats


def compose(adapter: str, layers: Sequence[PosedSplats], camera: Camera, with_depth: bool = False) -> ComposedImage:
    """Render layers with a camera on the adapter of that name; see `cpu.compose.compose`.

    Raises DeviceError where the adapter fails.
    """
    try:
        return _Composition(_rasterizer(adapter), layers, camera).image(with_depth)
    except DeviceError:
        _rasterizer.cache_clear()
        raise


@cache
def _rasterizer(adapter: str) -> Rasterizer:
    return Rasterizer(Device(adapter))


class _Composition:
    """Layers on a device: each has its own view of the same camera, and all share the tables of projected splats."""

    def __init__(self, rasterizer: Rasterizer, layers: Sequence[PosedSplats], camera: Camera) -> None:
        self._rasterizer, self._device, self._camera, self._layers = rasterizer, rasterizer.device, camera, layers
        self._frames = [layer_frames(layer, camera) for layer in layers]
        self._tables = [self._upload(n, layer) for n, layer in enumerate(layers)]
        self._on_device = [upload_frames(self._device, frames, f" {n}") for n, frames in enumerate(self._frames)]
        self._count = sum(table.count for table in self._tables)

    def image(self, with_depth: bool) -> ComposedImage:
        camera, read = self._camera, self._device.read
        rendering = self._render()
        while not self._rasterizer.pairs_fit():
            rendering = self._render()
        alpha = 1 - read(rendering.pixels, (camera.height, camera.width, 2))[..., 0]
        rgb = read(rendering.image, (3, camera.height, camera.width))
        if not with_depth:
            return ComposedImage(rgb, alpha, None)
        with self._device.record() as work:
            seen, lists, tile_table = self._project(work, depth_as_color=True), rendering.lists, rendering.tile_table
            image, _ = blend_forward(
                work, camera.width * camera.height, rendering.tiles, view=rendering.view, rendered=tile_table.rendered,
                tile_range=tile_table.tile_range, pair_slot=lists.pair_slot, slot_splat=lists.slot_splat,
                projected=seen.projected,
            )  # fmt: skip
        depth = read(image, (camera.height, camera.width))
        return ComposedImage(rgb, alpha, depth / np.maximum(alpha, np.finfo(np.float32).tiny))

    def _upload(self, n: int, layer: PosedSplats) -> SplatTable:
        parameters = Parameters(*(getattr(layer.splats, name) for name in Parameters._fields))
        return upload_splats(self._device, parameters, layer.splats.face, f" {n}")

    def _render(self) -> Rendering:
        """The colors, of all layers together; submitted."""
        every = SplatTable(None, None, self._count, 0, 0)
        view = self._rasterizer.upload_view(every, ViewOptions(self._camera, 0))
        with self._device.record() as work:
            return self._rasterizer.draw(work, self._project(work), self._count, self._camera, view)

    def _project(self, work: Recording, depth_as_color: bool = False) -> ProjectedSplats:
        """Record the projection of every layer."""
        first, seen = 0, projected_tables(work.device, self._count)
        for n, (layer, table, frames) in enumerate(zip(self._layers, self._tables, self._frames, strict=True)):
            view = self._rasterizer.upload_view(
                table, self._options(layer, frames, depth_as_color), frames.to_world, first, f"view {n}"
            )
            given = {"splats": table.rows, "face": table.face, "frames": self._on_device[n]}
            project(work, table.count, seen, view=view, **given)
            first += table.count
        return seen

    def _options(self, layer: PosedSplats, frames: CameraFrames, depth_as_color: bool) -> ViewOptions:
        return ViewOptions(
            self._camera, layer.splats.sh_degree, strains=frames.strain.shape[1], depth_as_color=depth_as_color,
            antialiased=layer.antialiased,
        )  # fmt: skip
