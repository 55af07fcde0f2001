"""Outlines of masks, outside of which splats are pruned: a needle beside the hair, which a few
images call for and many others push back, would survive the training."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from ...avatar.embedding import FaceFrames, points_to_world
from ...capture.camera import Camera
from ...capture.images import area_mean, read_mask
from ...capture.model import Capture
from .density import prunable
from .hull_points import pixels_of
from .state import TrainState, keep_rows

MAX_OUTLINES = 16
MAX_OUTLINE_HEIGHT_PX = 400
"""Masks higher than this are shrunk to it."""
TOLERANCE_SHARE = 0.01
"""Error of masks and tracking, as a share of the image height."""
MAX_OUTSIDE_SHARE = 0.5
"""Share of the outlines in whose image a point lies, that it may lie outside of."""


@dataclass(frozen=True)
class Outline:
    """What a training view's mask leaves clear, with a margin, (H, W) bool; camera: of that
    size."""

    timestep: int
    camera: Camera
    clear: np.ndarray


def read_outlines(capture: Capture, seed: int) -> list[Outline]:
    """Of MAX_OUTLINES training views drawn by `seed`, those with a mask. Raises StgaError as
    `read_mask` does."""
    views, outlines = capture.views["train"], []
    for n in np.random.default_rng(seed).permutation(len(views))[:MAX_OUTLINES]:
        view, mask = views[n], read_mask(views[n])
        if mask is None:
            continue
        camera = view.camera.scaled(min(1.0, MAX_OUTLINE_HEIGHT_PX / view.camera.height))
        margin = max(1, round(TOLERANCE_SHARE * camera.height))
        covered = area_mean(mask, camera.height, camera.width) > 127
        outlines.append(
            Outline(view.timestep, camera, ~binary_dilation(covered, iterations=margin))
        )
    return outlines


def prune_outside(
    state: TrainState,
    frames: Callable[[int], FaceFrames],
    outlines: Sequence[Outline],
    region: np.ndarray | None = None,
) -> TrainState:
    """Prune the splats whose center lies outside of most of the outlines in whose image it lies.

    frames: timestep -> the frames of the triangles; region (F,) bool: the triangles whose splats
    may change, None for all. Every triangle with bound splats keeps one.
    """
    seen, outside = np.zeros((2, len(state)), np.int32)
    for outline in outlines:
        points = points_to_world(state.parameters.xyz, frames(outline.timestep), state.face)
        x, y, shown = pixels_of(points, outline.camera)
        seen += shown
        outside += shown & outline.clear[y, x]
    stray = outside > MAX_OUTSIDE_SHARE * seen
    if region is not None:
        stray &= region[state.face]
    return keep_rows(state, ~prunable(state, stray))
