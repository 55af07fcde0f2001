"""Pruning of splats outside of the masks: without it, a needle beside the hair that a few images
call for, and many others reject, would survive the training."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from ...avatar.embedding import FaceFrames
from ...capture.camera import Camera
from ...capture.images import area_mean, read_mask
from ...capture.model import Capture
from ...raster.cpu.project import count_marked
from ...raster.cpu.rasterize import frames_in_camera
from .backend import Backend
from .state import PRUNED_BY, prunable
from .step_hook import Schedule

MAX_OUTLINES = 16
"""Views whose masks are read."""
MAX_OUTLINE_HEIGHT_PX = 400
"""Height to which higher masks are shrunk."""
TOLERANCE_FRACTION = 0.01
"""Error of masks and tracking, as a fraction of the image height."""
MAX_OUTSIDE_FRACTION = 0.5
"""Fraction of the outlines in whose image a point lies, that it may lie outside of."""
Coefficients = dict[str, np.ndarray]
"""Driven offset -> (F, 3, 3) float32."""


@dataclass(frozen=True)
class Outline:
    """Pixels (H, W) bool that a mask with a margin does not cover; camera: of that size."""

    timestep: int
    camera: Camera
    clear: np.ndarray


def read_outlines(capture: Capture, seed: int) -> list[Outline]:
    """Outlines of those of MAX_OUTLINES training views, drawn by `seed`, that have a mask. Raises
    StgaError."""
    views = capture.views["train"]
    outlines = []
    for n in np.random.default_rng(seed).permutation(len(views))[:MAX_OUTLINES]:
        view = views[n]
        mask = read_mask(views[n])
        if mask is None:
            continue
        camera = view.camera.scaled(min(1.0, MAX_OUTLINE_HEIGHT_PX / view.camera.height))
        covered = area_mean(mask, camera.height, camera.width) > 127
        outlines.append(Outline(view.timestep, camera, clear_of(covered)))
    return outlines


def clear_of(covered: np.ndarray, margin_fraction: float = TOLERANCE_FRACTION) -> np.ndarray:
    """(H, W) bool: pixels that a mask (H, W) bool does not cover, without a margin beside it; a
    negative margin includes pixels within it. margin_fraction: fraction of the height."""
    margin = max(1, round(abs(margin_fraction) * len(covered)))
    moved = binary_dilation if margin_fraction > 0 else binary_erosion
    return np.asarray(~moved(covered, iterations=margin))


class OutlinePruning:
    """Prunes splats whose center lies outside of most of the outlines in whose image it lies. Every
    triangle with bound splats keeps one.

    frames  timestep, coefficients of driven offsets -> the frames of the triangles
    """

    interval = 200

    def __init__(
        self, capture: Capture, seed: int, frames: Callable[[int, Coefficients], FaceFrames]
    ) -> None:
        self._capture = capture
        self._seed = seed
        self._frames = frames

    @cached_property
    def outlines(self) -> list[Outline]:
        return read_outlines(self._capture, self._seed)

    def prepare(self) -> None:
        self.outlines  # noqa: B018

    def apply(self, backend: Backend, schedule: Schedule) -> None:
        coefficients = backend.coefficients()
        columns = backend.columns(("parameters/xyz", *PRUNED_BY))
        face = columns["face"]
        outside = is_outside(
            columns["parameters/xyz"],
            face,
            lambda timestep: self._frames(timestep, coefficients),
            self.outlines,
        )
        if schedule.region is not None:
            outside &= schedule.region[face]
        unwanted = prunable(columns, outside)
        if unwanted.any():
            backend.keep(~unwanted)


def is_outside(
    xyz: np.ndarray,
    face: np.ndarray,
    frames: Callable[[int], FaceFrames],
    outlines: Sequence[Outline],
) -> np.ndarray:
    """(N,) bool: whether points (N, 3), local to triangles (N,), lie outside of most of the
    outlines in whose image they lie; frames: of a timestep's triangles."""
    inside, outside = np.zeros((2, len(face)), np.int32)
    rows = np.arange(len(face), dtype=np.int32)
    for n, outline in enumerate(outlines):
        left = len(outlines) - n  # without those that all of these could not take for outside
        rows = rows[outside[rows] + left > MAX_OUTSIDE_FRACTION * (inside[rows] + left)]
        in_camera = frames_in_camera(frames(outline.timestep), outline.camera)
        count_marked(rows, xyz, face, in_camera, outline.clear, inside, outside)
    return np.asarray(outside > MAX_OUTSIDE_FRACTION * inside)
