"""Colors of a capture's triangles: what the light of a recording is estimated from."""

from dataclasses import dataclass

import numpy as np

from ..capture.color import srgb_to_linear
from ..capture.images import read_view
from ..capture.mesh_raster import rasterize
from ..capture.model import Capture, View, evenly_spread
from ..capture.rigid import weighted_procrustes
from ..progress import Progress, Report, ignore

MAX_TIMESTEPS, MAX_CAMERAS, MAX_SIDE_PX = 10, 12, 400
"""Views that are looked at, evenly spread, and the size that larger images are reduced to."""
MIN_FACING = 0.35
"""Cosine between a triangle's normal and the direction to the camera, below which its color is not used."""
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
    """(F, 3) linear mean color of the pixels of each triangle; NaN where there is none, or it is seen aslant."""
    scale = min(1.0, MAX_SIDE_PX / max(view.camera.width, view.camera.height))
    view, image, mask = read_view(view, scale)
    triangle, _ = rasterize(mesh, capture.faces, view.camera)
    usable = (triangle >= 0) & (image.max(2) < SATURATED) & (image.max(2) > DARK)
    if mask is not None:
        usable &= _inner(mask > 127)
    corners = mesh[capture.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    to_camera = view.camera.position - corners.mean(1)
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(to_camera, axis=1)
    facing = (normal * to_camera).sum(1) > MIN_FACING * lengths
    where, linear = triangle[usable], srgb_to_linear(image[usable] / 255)
    count = np.bincount(where, minlength=len(facing))
    total = np.stack([np.bincount(where, channel, len(facing)) for channel in linear.T], axis=-1)
    return np.where(((count > 0) & facing)[:, None], total / np.maximum(count, 1)[:, None], np.nan)


def _inner(mask: np.ndarray) -> np.ndarray:
    """The mask (H, W) bool without pixels within two of its border."""
    padded = np.pad(mask, 2)
    height, width = mask.shape
    around = (0, 2), (4, 2), (2, 0), (2, 4), (1, 1), (1, 3), (3, 1), (3, 3)
    return np.logical_and.reduce([padded[y : y + height, x : x + width] for y, x in around])


def _darker_half(colors: np.ndarray) -> np.ndarray:
    """(F, 3) of colors by camera (C, F, 3), NaN where unseen: channel by channel the mean of the darker half."""
    ordered = np.sort(colors, axis=0)  # NaN comes last
    count = np.isfinite(colors[..., :1]).sum(0)
    taken = np.arange(len(colors))[:, None, None] < (count + 1) // 2
    total = np.where(taken, np.nan_to_num(ordered), 0).sum(0)
    return np.where(count > 0, total / np.maximum((count + 1) // 2, 1), np.nan)
