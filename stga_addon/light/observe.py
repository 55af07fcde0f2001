"""Colors of a capture's triangles: what the light of a recording is estimated from."""

from dataclasses import dataclass

import numpy as np

from ..capture.color import srgb_to_linear
from ..capture.images import read_view
from ..capture.model import Capture, View, evenly_spread
from ..capture.rigid import weighted_procrustes
from ..progress import Progress, Report, ignore
from .shadows import ShadowMap
from .values import Light

MAX_TIMESTEPS, MAX_CAMERAS, MAX_SIDE_PX = 10, 12, 800
"""Views that are looked at, evenly spread, and the size that larger images are reduced to."""
MIN_FACING = 0.35
"""Cosine between a triangle's normal and the direction to the camera, below which its color is not used."""
HIDDEN_M = 0.003
"""A triangle is hidden by what is nearer to the camera by as much."""
POINTS = (np.eye(3) + 1 / 3) / 2
"""(3, 3) barycentric coordinates of the points of a triangle whose pixels are read."""
SATURATED, DARK = 252, 4
"""Levels of 255 from which on, and up to which, a channel says nothing."""


@dataclass(frozen=True)
class Observed:
    """Triangles' colors at T timesteps.

    color     (T, F, 3) linear; NaN where no camera sees the triangle
    rotation  (T, 3, 3) from the axes of the world to those of the neutral mesh
    """

    color: np.ndarray
    rotation: np.ndarray


def observe(capture: Capture, report: Report = ignore) -> Observed:
    """Mean color of each triangle in the darker half of the cameras that face it, which have the fewest highlights.

    Reads up to MAX_TIMESTEPS × MAX_CAMERAS images.
    """
    by_time: dict[int, list[View]] = {}
    for view in capture.views.get("train", ()):
        by_time.setdefault(view.timestep, []).append(view)
    times = evenly_spread(sorted(by_time), MAX_TIMESTEPS)
    colors, rotations = [], []
    for n, time in enumerate(times):
        report(Progress(n / max(len(times), 1), "Estimating the light"))
        mesh = np.asarray(capture.mesh(time), np.float64)
        seen = [_view_colors(capture, mesh, view) for view in evenly_spread(by_time[time], MAX_CAMERAS)]
        colors.append(_darker_half(np.stack(seen)))
        rotations.append(weighted_procrustes(mesh, capture.neutral, np.ones(len(mesh)))[0])
    return Observed(np.stack(colors), np.stack(rotations))


def _view_colors(capture: Capture, mesh: np.ndarray, view: View) -> np.ndarray:
    """(F, 3) linear mean color of each triangle at POINTS; NaN where it is hidden or seen aslant."""
    scale = min(1.0, MAX_SIDE_PX / max(view.camera.width, view.camera.height))
    view, image, mask = read_view(view, scale)
    level = image.max(2)
    usable = (level < SATURATED) & (level > DARK)
    if mask is not None:
        usable &= _inner(mask > 127)
    corners = mesh[capture.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    to_camera = view.camera.position - corners.mean(1)
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(to_camera, axis=1)
    facing = (normal * to_camera).sum(1) > MIN_FACING * lengths
    depths = ShadowMap(mesh, capture.faces, Light("point", np.ones(3), view.camera.position))
    facing &= depths.lit(corners.mean(1), HIDDEN_M, step=0) > 0.5
    total, count = np.zeros((len(facing), 3)), np.zeros((len(facing), 1))
    for weights in POINTS:
        pixels, _ = view.camera.project(np.einsum("k,fkc->fc", weights, corners))
        column, row = np.floor(pixels).astype(np.int64).T
        inside = facing & (column >= 0) & (row >= 0) & (column < image.shape[1]) & (row < image.shape[0])
        column, row = np.where(inside, column, 0), np.where(inside, row, 0)
        inside &= usable[row, column]
        total += np.where(inside[:, None], srgb_to_linear(image[row, column] / 255), 0)
        count += inside[:, None]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _inner(mask: np.ndarray) -> np.ndarray:
    """The mask (H, W) bool without pixels within two of its border."""
    padded = np.pad(mask, 2)
    height, width = mask.shape
    around = (0, 2), (4, 2), (2, 0), (2, 4), (1, 1), (1, 3), (3, 1), (3, 3)
    return np.asarray(np.logical_and.reduce([padded[y : y + height, x : x + width] for y, x in around]))


def _darker_half(colors: np.ndarray) -> np.ndarray:
    """(F, 3) of colors by camera (C, F, 3), NaN where unseen: channel by channel the mean of the darker half."""
    ordered = np.sort(colors, axis=0)  # NaN comes last
    count = np.isfinite(colors[..., :1]).sum(0)
    taken = np.arange(len(colors))[:, None, None] < (count + 1) // 2
    total = np.where(taken, np.nan_to_num(ordered), 0).sum(0)
    return np.where(count > 0, total / np.maximum((count + 1) // 2, 1), np.nan)
