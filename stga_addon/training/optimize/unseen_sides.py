"""Sides of the head that no training view shows: their splats keep a plausible color.

Nothing but what shines through the front trains them, which gives them any color.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...avatar.splats import SH_C0
from ...capture.camera import look_at
from ...capture.mesh_geometry import connected_parts, rasterize
from ...capture.model import Capture, View, evenly_spread
from .initial_splats import mean_colors, mirror_images
from .state import TrainState

VIEWS = 48
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
    views = evenly_spread(capture.views["train"], VIEWS)
    cosine, outside = _largest_cosine(capture, views), _outside(capture)
    color, shown = mean_colors(capture, views)
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


def _largest_cosine(capture: Capture, views: list[View]) -> np.ndarray:
    """(F,) of the angle between each triangle and the camera that it faces most, whether it is in
    sight or not."""
    found = np.full(len(capture.faces), -1.0)
    for view in views:
        a, b, c = np.asarray(capture.mesh(view.timestep))[capture.faces].swapaxes(0, 1)
        normal, towards = np.cross(b - a, c - a), view.camera.position - (a + b + c) / 3
        length = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
        found = np.maximum(found, (normal * towards).sum(1) / np.maximum(length, 1e-20))
    return found


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
