"""Colors of a capture's triangles: what the light of a recording is estimated from."""

from dataclasses import dataclass

import numpy as np

from ..capture.color import srgb_to_linear
from ..capture.images import read_view
from ..capture.model import Capture, View, ViewExposure, evenly_spread
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

    color    (T, F, 3) linear; NaN where no camera sees the triangle
    cameras  (T, F) how many see it
    """

    color: np.ndarray
    cameras: np.ndarray


def views_by_time(capture: Capture) -> dict[int, list[View]]:
    """The training views that are looked at: up to MAX_CAMERAS of each of up to MAX_TIMESTEPS."""
    found: dict[int, list[View]] = {}
    for view in capture.views.get("train", ()):
        found.setdefault(view.timestep, []).append(view)
    return {time: evenly_spread(found[time], MAX_CAMERAS) for time in evenly_spread(sorted(found), MAX_TIMESTEPS)}


def observe(capture: Capture, exposure: ViewExposure, report: Report = ignore) -> Observed:
    """Mean color of each triangle in the darker half of the cameras that face it, which have the fewest highlights.

    T are those of `views_by_time`, in its order; reads all their images. exposure: as in `estimate.Known`.
    """
    by_time = views_by_time(capture)
    colors, cameras = [], []
    for n, (time, views) in enumerate(by_time.items()):
        report(Progress(n / max(len(by_time), 1), "Estimating the light"))
        mesh = np.asarray(capture.mesh(time), np.float64)
        seen = np.stack([_view_colors(capture, mesh, view, exposure(view)) for view in views])
        colors.append(_darker_half(seen))
        cameras.append(np.isfinite(seen[..., 0]).sum(0))
    return Observed(np.stack(colors), np.stack(cameras))


def _view_colors(capture: Capture, mesh: np.ndarray, view: View, exposure: np.ndarray | None) -> np.ndarray:
    """(F, 3) linear mean color of each triangle at POINTS, without its camera's exposure (2, 3); NaN where it is hidden
    or seen aslant."""
    gain, offset = np.eye(2)[:, :1] if exposure is None else exposure
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
        color = np.clip((image[row, column] - offset) / gain, 0, 255)
        total += np.where(inside[:, None], srgb_to_linear(color / 255), 0)
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
