"""Pictures that explain an avatar: beside the ground truth, and what a frame's selection trains."""

from dataclasses import replace

import numpy as np

from ..avatar.file import Avatar
from ..avatar.splats import SH_C0
from ..capture.camera import Camera
from .render import render_avatar


def selection_picture(avatar: Avatar, mesh: np.ndarray, camera: Camera, selected: np.ndarray) -> np.ndarray:
    """The paper's picture: splats of selected triangles in colour, frozen ones grey; (3, H, W) float32 on white.

    mesh (V, 3) drives the avatar; selected (F,) bool.
    """
    splats, frozen = avatar.splats, ~selected[avatar.splats.face]
    sh = splats.sh.copy()
    luminance = 0.5 + SH_C0 * sh[:, 0] @ np.array([0.299, 0.587, 0.114], np.float32)
    sh[frozen] = 0
    sh[frozen, 0] = ((0.25 + 0.4 * luminance[frozen]) - 0.5)[:, None] / SH_C0
    shown = replace(avatar, splats=replace(splats, sh=sh))
    return render_avatar(shown, mesh, camera, (1.0, 1.0, 1.0))


def side_by_side(pictures: list[np.ndarray]) -> np.ndarray:
    """Equally high pictures (H, W, 3) uint8 in a row, with a narrow white gap between them."""
    gap = np.full((len(pictures[0]), 6, 3), 255, np.uint8)
    spaced = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(spaced[:-1], axis=1)


def to_bytes(image: np.ndarray) -> np.ndarray:
    """(3, H, W) float32 in 0…1 to (H, W, 3) uint8."""
    return np.asarray(np.rint(np.clip(image, 0, 1).transpose(1, 2, 0) * 255), np.uint8)
