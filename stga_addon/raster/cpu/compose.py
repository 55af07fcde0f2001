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
    BLACK_BACKGROUND,
    BufferPool,
    CameraFrames,
    Parameters,
    frames_in_camera,
    interleave_tiles,
    sort_into_tiles,
    tile_grid,
    with_strain_color,
)


def compose(layers: Sequence[PosedSplats], camera: Camera, with_depth: bool = False) -> ComposedImage:
    """Draw layers through a camera; the same pixels as `render` makes of one."""
    counts = [len(layer.splats) for layer in layers]
    n = sum(counts)
    projected, depth = np.empty((n, PROJECTED), np.float32), np.empty(n, np.float32)
    extent_y, rect = np.empty(n, np.float32), np.empty((n, 4), np.int32)
    begin, everywhere = 0, np.ones(tile_grid(camera)[::-1], bool)
    for layer, count in zip(layers, counts, strict=True):
        splats, frames, part = layer.splats, _layer_frames(layer, camera), slice(begin, begin + count)
        arrays = Parameters(*(np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields))
        project_forward(
            np.arange(count), everywhere, *with_strain_color(arrays), splats.sh_degree, splats.face, frames.origin,
            frames.matrix,
            frames.strain, frames.to_world, frames.intrinsics, frames.size, False, layer.antialiased, projected[part],
            depth[part], extent_y[part], rect[part],
        )  # fmt: skip
        begin += count
    return _blended(projected, depth, extent_y, rect, camera, with_depth)


def _layer_frames(layer: PosedSplats, camera: Camera) -> CameraFrames:
    """A layer's frames from the camera; its splats' directions stay those of the space they were trained in."""
    to_camera = camera.world_to_camera @ layer.to_world
    frames = frames_in_camera(layer.frames, replace(camera, world_to_camera=to_camera))
    u, _, v = np.linalg.svd(to_camera[:3, :3])  # the rotation in it; what scales or mirrors is no direction
    return replace(frames, to_world=np.ascontiguousarray((u @ v).T, np.float32))


def _blended(
    projected: np.ndarray, depth: np.ndarray, extent_y: np.ndarray, rect: np.ndarray, camera: Camera, with_depth: bool
) -> ComposedImage:
    tiles_x, tiles_y = tile_grid(camera)
    lists = sort_into_tiles(depth, rect, camera, BufferPool().get)
    tiles = interleave_tiles(np.arange(tiles_x * tiles_y, dtype=np.int32))
    pair_rows = np.empty((len(lists.pair_splat), 4), np.uint8)

    def blend() -> tuple[np.ndarray, np.ndarray]:
        image = np.empty((3, camera.height, camera.width), np.float32)
        transmittance = np.empty((camera.height, camera.width), np.float32)
        last = np.empty((camera.height, camera.width), np.int32)
        blend_forward(
            tiles, tiles_x, lists.start, lists.pair_splat, projected, extent_y, BLACK_BACKGROUND, pair_rows, image,
            transmittance, last,
        )  # fmt: skip
        return image, 1 - transmittance

    rgb, alpha = blend()
    if not with_depth:
        return ComposedImage(rgb, alpha, None)
    projected[:, RED] = depth
    projected[:, GREEN] = projected[:, BLUE] = 0
    weighted = blend()[0][0]
    return ComposedImage(rgb, alpha, weighted / np.maximum(alpha, np.finfo(np.float32).tiny))
