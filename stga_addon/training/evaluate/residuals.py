"""Residuals per triangle: where an avatar differs from the images, as seen through its splats."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from ...avatar.file import Avatar
from ...avatar.splats import SH_C0
from ...capture.images import read_view
from ...capture.loader import Preparation
from ...capture.model import Capture, View
from ...raster.cpu.layout import Parameters
from ...raster.cpu.rasterize import BufferPool, frames_in_camera, render_backward, render_forward

RESIDUAL_SCALE = 0.5
"""Size of the images that residuals are measured in: what matters is larger than a pixel."""
MIN_WEIGHT_PX = 2.0
"""Pixels that a triangle's splats must cover together for its residual to be known."""


@dataclass(frozen=True)
class Residuals:
    """Absolute error (0…1, mean of the channels) by triangle, summed over views with the splats'
    blending weights.

    error, weight  (F,) float64: Σ weight · error and Σ weight over all pixels, in pixels
    """

    error: np.ndarray
    weight: np.ndarray

    def __add__(self, other: "Residuals") -> "Residuals":
        return Residuals(self.error + other.error, self.weight + other.weight)

    def mean(self) -> np.ndarray:
        """(F,) mean absolute error that each triangle's splats show; NaN where too little."""
        known = self.weight >= MIN_WEIGHT_PX
        return np.where(known, self.error / np.where(known, self.weight, 1.0), np.nan)


def triangle_residuals(
    avatar: Avatar,
    capture: Capture,
    views: Iterable[View],
    prepare: Preparation | None = None,
    scale: float = 1.0,
) -> Residuals:
    """Residuals of the avatar in the views; prepare: as in training; scale: size of the images
    compared. A pixel's error is divided among its splats by their blending weights."""
    splats, count, buffers = avatar.splats, len(avatar.faces), BufferPool()
    total, background = Residuals(*np.zeros((2, count))), np.array(avatar.background, np.float32)
    colored = Parameters(
        *(np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields)
    )
    # Gray: a color clamped at black would have no gradient. The blending weights do not depend on
    # colors.
    no_colors = np.zeros_like(splats.sh), np.zeros_like(splats.strain_color)
    gray = colored._replace(sh=no_colors[0], strain_color=no_colors[1])
    gradients = Parameters(*(np.zeros_like(array) for array in colored))
    red, green, blue = (round(255 * level) for level in avatar.background)
    for view in views:
        scaled, target, mask = read_view(view, scale, (red, green, blue))
        if prepare is not None:
            target, _ = prepare(scaled, target, mask)
        mesh = np.asarray(capture.mesh(view.timestep))
        frames = frames_in_camera(avatar.frames(mesh), scaled.camera)
        render = partial(
            render_forward, face=splats.face, frames=frames, background=background,
            antialiased=avatar.antialiased, buffers=buffers,
        )  # fmt: skip
        image = render(colored, degree=splats.sh_degree).image
        shown = target.transpose(2, 0, 1).astype(np.float32) / 255
        difference = np.abs(np.clip(image, 0, 1) - shown).mean(0)
        # The gradient with respect to a color is the sum of blending weights times that with
        # respect to the image.
        v_image = np.stack([difference, np.ones_like(difference), np.zeros_like(difference)])
        output = render(gray, degree=0)
        rows, _ = render_backward(
            output, gray, splats.face, frames, v_image, gradients, buffers=buffers
        )
        by_splat = gradients.sh[rows, 0, :2].astype(np.float64) / SH_C0
        face = splats.face[rows]
        total += Residuals(*(np.bincount(face, column, count) for column in by_splat.T))
    return total
