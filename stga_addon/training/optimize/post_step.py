"""Changes of the splats between steps beside density control: pruning outside of the masks, and
colors of sides of the head that no training view shows.

A needle beside the hair, which a few images call for and many others push back, would survive the
training. And nothing but what shines through the front trains a hidden side, which gives it any
color.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from ...avatar.embedding import FaceFrames, points_to_world
from ...avatar.splats import SH_C0
from ...capture.camera import Camera, look_at
from ...capture.images import area_mean, read_mask
from ...capture.mesh_geometry import connected_parts, rasterize
from ...capture.model import Capture, evenly_spread
from .density import prunable
from .hull_points import pixels_of
from .initial_splats import mean_colors, mirror_images
from .state import TrainState, keep_rows

MAX_OUTLINES = 16
MAX_OUTLINE_HEIGHT_PX = 400
"""Masks higher than this are shrunk to it."""
TOLERANCE_SHARE = 0.01
"""Error of masks and tracking, as a share of the image height."""
MAX_OUTSIDE_SHARE = 0.5
"""Share of the outlines in whose image a point lies, that it may lie outside of."""
SIDE_VIEWS = 48
"""Training views that are looked at, spread over all."""
MIN_COSINE, SOURCE_COSINE = -0.1, 0.5
"""Of the angle between a triangle and a camera: below the first, it faces away so far that not even
its hair stands in the outline; below the second, others do not take its color, which a matte's edge
may be in."""
SOURCE_TRIANGLES = 100
"""Of whose colors a hidden triangle has the median."""
OUTSIDE_CAMERAS, OUTSIDE_DISTANCE = 18, 4.0
"""Cameras around the neutral head that tell its outside from its inside; their distance, in its
radius."""


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


@dataclass(frozen=True)
class UnseenSides:
    """Triangles (F,) bool of the head's outside that no view shows, and the color (F, 3) from 0 to
    1 that they keep."""

    triangles: np.ndarray
    color: np.ndarray

    def restore(self, state: TrainState) -> TrainState:
        """Give bound splats on these triangles their color, the same from everywhere and in every
        expression."""
        rows = self.triangles[state.face] & ~state.unbound
        flat = (self.color[state.face[rows]] - 0.5) / SH_C0
        for kept in (state.parameters, state.average, state.first, state.second):
            kept.sh[rows] = kept.strain_color[rows] = 0
        state.parameters.sh[rows, 0] = state.average.sh[rows, 0] = flat
        return state


def unseen_sides(capture: Capture) -> UnseenSides:
    """Colors of mirror images, as far as these are shown, else of the nearest connected triangles
    that are."""
    views = evenly_spread(capture.views["train"], SIDE_VIEWS)
    cosine = np.full(len(capture.faces), -1.0)  # with the camera that a triangle faces most
    for view in views:
        a, b, c = np.asarray(capture.mesh(view.timestep))[capture.faces].swapaxes(0, 1)
        normal, towards = np.cross(b - a, c - a), view.camera.position - (a + b + c) / 3
        length = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
        cosine = np.maximum(cosine, (normal * towards).sum(1) / np.maximum(length, 1e-20))
    outside, (color, shown) = _outside(capture), mean_colors(capture, views)
    sources = np.flatnonzero(shown & outside & (cosine > SOURCE_COSINE))
    unseen = outside & (cosine < MIN_COSINE)
    if not len(sources):
        return UnseenSides(np.zeros_like(unseen), color)
    centers = np.asarray(capture.neutral)[capture.faces].mean(1)
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    for number in np.unique(part[unseen]):
        rows = np.flatnonzero(unseen & (part == number))
        own = sources[part[sources] == number] if (part[sources] == number).any() else sources
        _, near = cKDTree(centers[own]).query(centers[rows], min(SOURCE_TRIANGLES, len(own)))
        color[rows] = np.median(color[own[near.reshape(len(rows), -1)]], axis=1)
    hidden, partner = mirror_images(capture, unseen, shown & (cosine > SOURCE_COSINE))
    color[hidden] = color[partner]
    return UnseenSides(unseen, color)


def _outside(capture: Capture) -> np.ndarray:
    """(F,) bool: triangles of the neutral mesh that some camera around it sees."""
    neutral = np.asarray(capture.neutral, np.float64)
    center = neutral.mean(0)
    radius = max(float(np.linalg.norm(neutral - center, axis=1).max()), 1e-9)
    seen = np.zeros(len(capture.faces), bool)
    for number in range(OUTSIDE_CAMERAS):
        angle, height = 2 * np.pi * number / OUTSIDE_CAMERAS, (-0.5, 0.2, 0.9)[number % 3]
        eye = center + OUTSIDE_DISTANCE * radius * np.array([np.sin(angle), height, np.cos(angle)])
        camera = look_at(eye, center, 400, 400, focal_length=400 * OUTSIDE_DISTANCE / 2.2)
        triangle, _ = rasterize(neutral, capture.faces, camera)
        seen[np.unique(triangle[triangle >= 0])] = True
    return seen
