"""Several sets of splats in one picture, sorted by depth together, with alpha and depth for
compositing."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...capture.camera import Camera
from ..posed_splats import ComposedImage, PosedSplats
from . import rasterize
from .blend import blend_forward
from .layout import BLUE, GREEN, RED, CameraFrames, Parameters, Projection
from .project import project_forward
from .tiles import sum_tiles, whole_tiles


def compose(
    layers: Sequence[PosedSplats], camera: Camera, with_depth: bool = False
) -> ComposedImage:
    """Render layers with a camera; one layer gives the pixels of `render`."""
    buffers = rasterize.BufferPool()
    begin = 0
    tiles_x, tiles_y = rasterize.tile_grid(camera.width, camera.height)
    projection = rasterize.new_projection(sum(len(layer.splats) for layer in layers), buffers)
    everywhere = sum_tiles(np.ones((tiles_y, tiles_x), bool))
    for layer in layers:
        splats = layer.splats
        rows = slice(begin, begin + len(layer.splats))
        parameters = Parameters(
            *(np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields)
        )
        project_forward(
            np.ones(len(splats), bool),
            everywhere,
            parameters,
            splats.face,
            layer_frames(layer, camera),
            splats.sh_degree,
            False,
            layer.antialiased,
            Projection(*(array[rows] for array in projection)),
        )
        begin = rows.stop
    whole = whole_tiles(tiles_x * tiles_y)
    lists, tiles = rasterize.sort_into_tiles(projection, tiles_x, whole, buffers)
    blended = rasterize.new_image(camera.width, camera.height, lists, buffers)
    blend_forward(tiles, tiles_x, whole, lists, projection, rasterize.BLACK_BACKGROUND, blended)
    rgb = blended.image
    alpha = 1 - blended.transmittance
    if not with_depth:
        return ComposedImage(rgb, alpha, None)
    projection.columns[:, RED] = projection.depth
    projection.columns[:, GREEN] = projection.columns[:, BLUE] = 0
    blended = rasterize.new_image(camera.width, camera.height, lists, rasterize.BufferPool())
    blend_forward(tiles, tiles_x, whole, lists, projection, rasterize.BLACK_BACKGROUND, blended)
    depth = blended.image[0] / np.maximum(alpha, np.finfo(np.float32).tiny)
    return ComposedImage(rgb, alpha, depth)


def layer_frames(layer: PosedSplats, camera: Camera) -> CameraFrames:
    """A layer's frames in camera space; its splats' directions stay those of the space they were
    trained in."""
    to_camera = camera.world_to_camera @ layer.to_world
    frames = rasterize.frames_in_camera(layer.frames, replace(camera, world_to_camera=to_camera))
    # the rotation in it; scale and reflection do not change a direction
    u, _, v = np.linalg.svd(to_camera[:3, :3])
    return frames._replace(to_world=np.ascontiguousarray((u @ v).T, np.float32))
