"""Several sets of splats in one picture, sorted by depth together, with alpha and depth for compositing."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...capture.camera import Camera
from ..posed_splats import ComposedImage, PosedSplats
from .blend import blend_forward
from .layout import BLUE, GREEN, PROJECTED, RED
from .project import project_forward
from .rasterize import (
    BLACK,
    BufferPool,
    CameraFrames,
    Parameters,
    camera_frames,
    complete,
    deal,
    sort_into_tiles,
    tile_grid,
)


def compose(layers: Sequence[PosedSplats], camera: Camera, with_depth: bool = False) -> ComposedImage:
    """Draw layers through a camera; the same pixels as `render_splats` makes of one."""
    counts = [len(layer.splats) for layer in layers]
    n = sum(counts)
    projected, depth = np.empty((n, PROJECTED), np.float32), np.empty(n, np.float32)
    extent_y, rect = np.empty(n, np.float32), np.empty((n, 4), np.int32)
    begin, everywhere = 0, np.ones(tile_grid(camera)[::-1], bool)
    for layer, count in zip(layers, counts, strict=True):
        splats, seen, part = layer.splats, _seen(layer, camera), slice(begin, begin + count)
        arrays = Parameters(*(np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields))
        project_forward(
            np.arange(count), everywhere, *complete(arrays), splats.sh_degree, splats.face, seen.origin, seen.matrix,
            seen.strain, seen.to_world, seen.lens, seen.size, False, layer.antialiased, projected[part], depth[part],
            extent_y[part], rect[part],
        )  # fmt: skip
        begin += count
    return _blended(projected, depth, extent_y, rect, camera, with_depth)


def _seen(layer: PosedSplats, camera: Camera) -> CameraFrames:
    """A layer's frames from the camera; its splats' directions stay those of the space they were trained in."""
    to_camera = camera.world_to_camera @ layer.to_world
    seen = camera_frames(layer.frames, replace(camera, world_to_camera=to_camera))
    u, _, v = np.linalg.svd(to_camera[:3, :3])  # the rotation in it; what scales or mirrors is no direction
    return replace(seen, to_world=np.ascontiguousarray((u @ v).T, np.float32))


def _blended(
    projected: np.ndarray, depth: np.ndarray, extent_y: np.ndarray, rect: np.ndarray, camera: Camera, with_depth: bool
) -> ComposedImage:
    tiles_x, tiles_y = tile_grid(camera)
    bins = sort_into_tiles(depth, rect, camera, BufferPool().take)
    tiles = deal(np.arange(tiles_x * tiles_y, dtype=np.int32))
    pair_rows = np.empty((len(bins.pair_splat), 4), np.uint8)

    def blend() -> tuple[np.ndarray, np.ndarray]:
        image = np.empty((3, camera.height, camera.width), np.float32)
        transmittance = np.empty((camera.height, camera.width), np.float32)
        last = np.empty((camera.height, camera.width), np.int32)
        blend_forward(
            tiles, tiles_x, bins.start, bins.pair_splat, projected, extent_y, BLACK, pair_rows, image, transmittance,
            last,
        )  # fmt: skip
        return image, 1 - transmittance

    rgb, alpha = blend()
    if not with_depth:
        return ComposedImage(rgb, alpha, None)
    projected[:, RED] = depth
    projected[:, GREEN] = projected[:, BLUE] = 0
    weighted = blend()[0][0]
    return ComposedImage(rgb, alpha, weighted / np.maximum(alpha, np.finfo(np.float32).tiny))
