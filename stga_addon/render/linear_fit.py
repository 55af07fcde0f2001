"""Splats for renderers that blend in linear light, as Cycles, EEVEE and those of USD do: avatars
are trained in sRGB, where soft edges and hair come out darker."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..avatar.embedding import NO_COLUMNS, to_world
from ..avatar.file import Avatar
from ..avatar.splats import SH_C0, sh_color
from ..capture.camera import Camera
from ..capture.color import srgb_to_linear
from ..capture.model import Capture, evenly_spread
from ..errors import StgaError
from ..flame.quaternions import unit
from ..progress import Report, counted, ignore
from ..raster.cpu.layout import CameraFrames, Parameters
from ..raster.cpu.rasterize import BufferPool, frames_in_camera, render_backward, render_forward
from .render import render

STEPS = 120
"""Steps of Adam."""
MAX_VIEWS = 24
"""Views that are fitted, at most."""
MAX_SIDE_PX = 240
"""Larger side to which they are shrunk."""
RATES = np.array((0.01, 0.01, 0.01, 0.04), np.float32)
"""Adam's first rates, of colors in sRGB and of logits; they fall to 0."""
BETAS = 0.9, 0.999
"""Adam's decay rates of the mean gradient and of its mean square: the defaults of Kingma and Ba
(2015)."""
FINENESS = 2
"""Parts of a pixel, in each direction, that are averaged in linear light: other renderers average
samples, and do not blur what is thinner than a pixel, as ours does."""
BEHIND = 0.0, 1.0
"""Grays behind one half of the views and the other: what is behind an avatar is not known."""
MAX_SRGB = 1.12  # Largest value that is shown natively (`scene.display.splat_nodes`)


class _PosedView(NamedTuple):
    """A view of an avatar: frames of its triangles without their color, colors (N, 3) of the splats
    with it, sRGB; gray behind it, and the picture as trained (3, H, W), sRGB."""

    frames: CameraFrames
    color: np.ndarray
    behind: float
    picture: np.ndarray


def fit_linear(avatar: Avatar, capture: Capture, report: Report = ignore) -> np.ndarray:
    """`Avatar.linear_base` (N, 4) with which blending in linear light comes nearest to
    `render_avatar`, in display values, in views of the capture. Raises StgaError without any,
    Cancelled when the report stops it."""
    views = capture.views.get("train", ())
    if not views:
        raise StgaError(f"{capture.root}: has no training views, by which colors could be fitted")
    rng = np.random.default_rng(0)
    chosen = evenly_spread(views, MAX_VIEWS)
    posed_views = []
    for place, index in enumerate(rng.permutation(len(chosen))):
        view = chosen[index]
        camera = view.camera
        camera = camera.scaled(min(1.0, MAX_SIDE_PX / max(camera.width, camera.height)))
        posed_views.append(
            _posed_view(avatar, capture.mesh(view.timestep), camera, BEHIND[place % 2])
        )
    change = np.zeros((len(avatar.splats), 4), np.float32)
    mean = np.zeros_like(change)
    square = np.zeros_like(change)
    buffers = BufferPool()
    order = [
        n for _ in range(0, STEPS, len(posed_views)) for n in rng.permutation(len(posed_views))
    ]
    for step in counted(range(STEPS), STEPS, report, "Fitting colors for linear light", "Step"):
        gradient = _gradient(avatar, change, posed_views[order[step]], buffers)
        mean += (1 - BETAS[0]) * (gradient - mean)
        square += (1 - BETAS[1]) * (gradient**2 - square)
        unbiased = mean / (1 - BETAS[0] ** (step + 1))
        deviation = np.sqrt(square / (1 - BETAS[1] ** (step + 1))) + np.float32(1e-15)
        change -= (1 - step / STEPS) * RATES * unbiased / deviation
    change[:, :3] /= SH_C0
    return np.column_stack([avatar.splats.sh[:, 0], avatar.splats.opacity]) + change


def _posed_view(avatar: Avatar, mesh: np.ndarray, camera: Camera, behind: float) -> _PosedView:
    frames = avatar.frames(mesh)
    world = to_world(avatar.splats, frames)
    direction = unit(world.xyz - camera.position.astype(np.float32))
    picture = render(avatar.splats, camera, (behind,) * 3, frames, avatar.antialiased)
    colorless = replace(frames, color=NO_COLUMNS)
    fine = frames_in_camera(colorless, camera.scaled(FINENESS))
    return _PosedView(fine, sh_color(world.sh, direction), behind, picture)


def _gradient(
    avatar: Avatar, change: np.ndarray, view: _PosedView, buffers: BufferPool
) -> np.ndarray:
    """(N, 4) of half the mean squared difference of a view blended in linear light from its
    picture, in display values, by the change of colors and logits."""
    splats = avatar.splats
    srgb = np.clip(view.color + change[:, :3], 0, MAX_SRGB)
    values = {name: np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields}
    values["sh"] = ((srgb_to_linear(srgb) - 0.5) / SH_C0).astype(np.float32)[:, None]
    values["opacity"] = splats.opacity + change[:, 3]
    parameters = Parameters(**values)
    behind = np.full(3, view.behind, np.float32)
    output = render_forward(
        parameters,
        splats.face,
        view.frames,
        0,
        behind,
        antialiased=avatar.antialiased,
        buffers=buffers,
    )
    channels, height, width = view.picture.shape
    fine = output.image.reshape(channels, height, FINENESS, width, FINENESS)
    difference = fine.mean((2, 4)) - srgb_to_linear(view.picture)
    difference /= _slope(view.picture) ** 2 * difference.size * FINENESS**2
    by_image = difference.repeat(FINENESS, 1).repeat(FINENESS, 2).astype(np.float32)
    by = Parameters(*(np.zeros_like(each) for each in parameters))
    render_backward(output, parameters, splats.face, view.frames, by_image, by, buffers=buffers)
    by_color = by.sh[:, 0] / SH_C0 * _slope(srgb)
    return np.asarray(np.column_stack([by_color, by.opacity]), np.float32)


def _slope(srgb: np.ndarray) -> np.ndarray:
    """Derivative of linear light by sRGB."""
    curve = 2.4 / 1.055 * ((srgb + 0.055) / 1.055) ** 1.4
    return np.where(srgb > 0.04045, curve, 1 / 12.92)
