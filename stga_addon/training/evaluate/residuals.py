"""Residuals per triangle: where an avatar differs from the images, as seen through its splats."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...avatar.file import Avatar
from ...avatar.splats import SH_C0
from ...capture.camera import Camera
from ...capture.images import read_view
from ...capture.loader import Preparation
from ...capture.model import Capture, View
from ...raster.cpu.layout import CameraFrames, Parameters
from ...raster.cpu.rasterize import (
    BufferPool,
    RenderOutput,
    frames_in_camera,
    render_backward,
    render_forward,
)

RESIDUAL_SCALE = 0.5
"""Size of the images in which the residuals of a run are measured: an error that matters is larger
than a pixel."""
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
        """(F,) mean absolute error of what each triangle's splats show; NaN where they show too
        little."""
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
    compared.

    A pixel's error is divided among the splats that it shows, by their blending weights.
    """
    total = Residuals(np.zeros(len(avatar.faces)), np.zeros(len(avatar.faces)))
    probe = _Probe(avatar)
    red, green, blue = (round(255 * level) for level in avatar.background)
    for view in views:
        scaled, image, mask = read_view(view, scale, (red, green, blue))
        if prepare is not None:
            image, _ = prepare(scaled, image, mask)
        total = total + probe.residuals(
            np.asarray(capture.mesh(view.timestep)), scaled.camera, image
        )
    return total


class _Probe:
    """Renders an avatar and attributes an image to its triangles."""

    def __init__(self, avatar: Avatar) -> None:
        splats = avatar.splats
        self._avatar, self._buffers = avatar, BufferPool()
        self._splats = Parameters(
            *(np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields)
        )
        # Gray: a color clamped at black would have no gradient. The blending weights do not depend
        # on colors.
        self._gray = self._splats._replace(
            sh=np.zeros_like(splats.sh), strain_color=np.zeros_like(splats.strain_color)
        )
        self._gradients = Parameters(*(np.zeros_like(array) for array in self._splats))

    def residuals(self, mesh: np.ndarray, camera: Camera, target: np.ndarray) -> Residuals:
        """Of one image, target (H, W, 3) uint8."""
        avatar, splats = self._avatar, self._avatar.splats
        frames = frames_in_camera(avatar.frames(mesh), camera)
        shown = self._render(self._splats, frames, splats.sh_degree).image
        difference = np.abs(
            np.clip(shown, 0, 1) - target.transpose(2, 0, 1).astype(np.float32) / 255
        ).mean(0)
        # The gradient with respect to a color is the sum of blending weights times that with
        # respect to the image.
        v_image = np.stack([difference, np.ones_like(difference), np.zeros_like(difference)])
        gray = self._render(self._gray, frames, 0)
        rows, _ = render_backward(
            gray, self._gray, splats.face, frames, v_image, self._gradients, buffers=self._buffers
        )
        by_splat = self._gradients.sh[rows, 0, :2].astype(np.float64) / SH_C0
        sums = [np.bincount(splats.face[rows], column, len(avatar.faces)) for column in by_splat.T]
        return Residuals(sums[0], sums[1])

    def _render(self, splats: Parameters, frames: CameraFrames, degree: int) -> RenderOutput:
        avatar = self._avatar
        background = np.array(avatar.background, np.float32)
        return render_forward(
            splats, avatar.splats.face, frames, degree, background, antialiased=avatar.antialiased,
            buffers=self._buffers,
        )  # fmt: skip
