"""Colors of sides of the head that no training view shows: only what shines through the front
trains a hidden side, which gives it any color."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ...avatar.splats import SH_C0
from ...capture.camera import look_at
from ...capture.mesh_geometry import connected_parts, rasterize
from ...capture.model import Capture, evenly_spread
from .backend import Backend
from .change import Turn
from .initial_splats import mean_colors, mirror_images

SIDE_VIEWS = 48
"""Training views that are looked at, spread over all."""
MIN_COSINE = -0.1
SOURCE_COSINE = 0.5
"""Of the angle between a triangle and a camera: below the first, it faces away so far that not even
its hair stands in the outline; below the second, others do not take its color, which a matte's edge
may be in."""
SOURCE_TRIANGLES = 100
"""Of whose colors a hidden triangle has the median."""
OUTSIDE_CAMERAS = 18
OUTSIDE_DISTANCE = 4.0
"""Cameras that tell the neutral head's outside from its inside; their distance, in its radius."""


@dataclass(frozen=True)
class UnseenSides:
    """Triangles (F,) bool of the outside that no view shows; the color (F, 3) in 0…1 they keep."""

    triangles: np.ndarray
    color: np.ndarray


class UnseenSideColors:
    """Gives bound splats of unseen sides their color, from everywhere and in every expression."""

    interval = 100

    def __init__(self, capture: Capture) -> None:
        self._capture = capture

    @cached_property
    def sides(self) -> UnseenSides:
        return unseen_sides(self._capture)

    def prepare(self) -> None:
        self.sides  # noqa: B018

    def apply(self, backend: Backend, turn: Turn) -> None:
        columns = backend.columns(("face", "unbound", "parameters/sh"))
        face = columns["face"]
        rows = np.flatnonzero(self.sides.triangles[face] & ~columns["unbound"])
        sh = np.zeros((len(rows), *columns["parameters/sh"].shape[1:]), np.float32)
        sh[:, 0] = (self.sides.color[face[rows]] - 0.5) / SH_C0
        backend.assign(
            rows, {"parameters/sh": sh, "average/sh": sh, "first/sh": 0.0, "second/sh": 0.0}
        )


def unseen_sides(capture: Capture) -> UnseenSides:
    """Colored as mirror images that are shown, else as the nearest connected triangles."""
    views = evenly_spread(capture.views["train"], SIDE_VIEWS)
    cosine = np.full(len(capture.faces), -1.0)  # with the camera that a triangle faces most
    for view in views:
        a, b, c = np.asarray(capture.mesh(view.timestep))[capture.faces].swapaxes(0, 1)
        normal = np.cross(b - a, c - a)
        towards = view.camera.position - (a + b + c) / 3
        length = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
        cosine = np.maximum(cosine, (normal * towards).sum(1) / np.maximum(length, 1e-20))
    outside = _outside(capture)
    (color, shown) = mean_colors(capture, views)
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
        angle = 2 * np.pi * number / OUTSIDE_CAMERAS
        height = (-0.5, 0.2, 0.9)[number % 3]
        eye = center + OUTSIDE_DISTANCE * radius * np.array([np.sin(angle), height, np.cos(angle)])
        camera = look_at(eye, center, 400, 400, focal_length=400 * OUTSIDE_DISTANCE / 2.2)
        triangle, _ = rasterize(neutral, capture.faces, camera)
        seen[np.unique(triangle[triangle >= 0])] = True
    return seen
