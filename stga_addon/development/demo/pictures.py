"""Pictures of the demo: an avatar beside the ground truth, and the splats that one selection trains."""

from dataclasses import replace

import numpy as np

from ...avatar.file import Avatar
from ...avatar.splats import SH_C0
from ...capture.camera import Camera
from ...render.render import render_avatar


def selection_picture(avatar: Avatar, mesh: np.ndarray, camera: Camera, selected: np.ndarray) -> np.ndarray:
    """The avatar with splats of selected triangles in color and all others gray; (3, H, W) float32 on white.

    mesh (V, 3) drives the avatar; selected (F,) bool.
    """
    splats, gray = avatar.splats, ~selected[avatar.splats.face]
    sh = splats.sh.copy()
    luminance = 0.5 + SH_C0 * sh[:, 0] @ np.array([0.299, 0.587, 0.114], np.float32)
    sh[gray] = 0
    sh[gray, 0] = ((0.25 + 0.4 * luminance[gray]) - 0.5)[:, None] / SH_C0
    return render_avatar(replace(avatar, splats=replace(splats, sh=sh)), mesh, camera)


def side_by_side(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures (H, W, 3) uint8 of one height in a row, with a white gap of six pixels between them."""
    gap = np.full((len(pictures[0]), 6, 3), 255, np.uint8)
    spaced = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(spaced[:-1], axis=1)
