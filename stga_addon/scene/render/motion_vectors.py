"""The Vector pass: how far each pixel's splats move, in the convention of Cycles."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...avatar.embedding import NO_COLUMNS, points_to_world
from ...avatar.splats import SH_C0
from ...raster.posed_splats import ComposedImage
from ..gpu.packing import View
from ..layers import SceneLayer

MIN_DEPTH_M = 1e-4
"""Splats nearer to the camera's plane than this have no place in the image."""


def pixel_centers(layers: Sequence[SceneLayer], view: View) -> list[np.ndarray]:
    """(N, 2) pixels right and up of each layer's splats; nan beside or behind the camera."""
    camera = view.camera
    found = []
    for layer in layers:
        splats = layer.splats
        placed = points_to_world(splats.xyz, layer.frames, splats.face)
        to_camera = camera.world_to_camera @ layer.to_world
        x, y, depth = to_camera[:3, :3] @ placed.T + to_camera[:3, 3:]
        depth = np.where(depth > MIN_DEPTH_M, depth, np.nan)
        found.append(np.stack([camera.fl_x * x / depth, -camera.fl_y * y / depth], axis=1))
        found[-1] += camera.cx, -camera.cy
    return found


def moved(now: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> list[np.ndarray]:
    """(N, 2) pixels from where splats are now to where they are in another frame; 0 where a splat
    has no place in either, and everywhere where that frame shows other splats."""
    if [len(each) for each in now] != [len(each) for each in other]:
        return [np.zeros((len(each), 2)) for each in now]
    return [np.nan_to_num(there - here) for here, there in zip(now, other, strict=True)]


def painted(
    layers: Sequence[SceneLayer], motion: Sequence[np.ndarray]
) -> tuple[list[SceneLayer], float]:
    """The layers in colors that are their motion (N, 2): 0.5 plus a multiple; and its divisor."""
    largest = max((float(np.abs(each).max(initial=0)) for each in motion), default=0.0)
    scale = 2 * max(largest, 1e-6)
    colored = []
    for layer, moved in zip(layers, motion, strict=True):
        sh = np.zeros((len(moved), 1, 3), np.float32)
        sh[:, 0, :2] = moved / (scale * SH_C0)
        frames = replace(layer.frames, color=NO_COLUMNS)
        settings = replace(layer.settings, show_selection=False, show_unseen=False)
        splats = replace(layer.splats, sh=sh)
        colored.append(replace(layer, splats=splats, frames=frames, settings=settings, relit=None))
    return colored, scale


def read_motion(image: ComposedImage, scale: float, least_alpha: float) -> np.ndarray:
    """(H, W, 2) pixels, the mean over a pixel's splats; 0 below an alpha."""
    covered = image.alpha >= least_alpha
    mean = image.rgb[:2] / np.where(covered, image.alpha, 1.0)
    return np.where(covered, scale * (mean - 0.5), 0.0).transpose(1, 2, 0)
