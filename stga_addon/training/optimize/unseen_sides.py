"""Colors of what no training view shows, sides of the head and the inside of a closed mouth: only
what shines through the front trains it, which gives it any color."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ...avatar.splats import SH_C0
from ...capture.camera import look_at
from ...capture.mesh_geometry import connected_parts, rasterize
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from .backend import Backend
from .change import Turn
from .frames import FACING_TIMESTEPS, UNSEEN_COSINE, FrameStore
from .initial_splats import mean_colors, mirror_images
from .likeness import (
    hairy_triangles,
    head_coordinates,
    inside_colors,
    kinds_of,
    sources_around_head,
    teeth_of,
)

SPREAD_VIEWS = 12
OPEN_VIEWS = 6
"""Training views whose colors are looked at, spread over all, and of the timesteps in which the
mouth is highest."""
MIN_TEETH_SHARE = 0.08
"""Of the teeth's triangles, half of which are behind others, that views show at least."""
SOURCE_COSINE = 0.5
"""Of the angle between a triangle and a camera: below it, others do not take its color, which a
matte's edge may be in."""
SOURCE_TRIANGLES = 100
"""Of whose colors a hidden triangle has the median."""
OUTSIDE_CAMERAS = 15
OUTSIDE_DISTANCE = 4.0
OUTSIDE_SIDE_PX = 240
"""Cameras that tell the neutral head's outside from its inside; their distance, in its radius;
width and height of their images."""


@dataclass(frozen=True)
class UnseenSides:
    """Triangles (F,) bool that no view shows; the color (F, 3) in 0…1 that they keep."""

    triangles: np.ndarray
    color: np.ndarray


class UnseenSideColors:
    """Gives bound splats of unseen triangles their color, from everywhere and in every
    expression."""

    interval = 20

    def __init__(self, frames: FrameStore) -> None:
        self._frames = frames

    @cached_property
    def sides(self) -> UnseenSides:
        return unseen_sides(self._frames.capture, self._frames.facing)

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


def unseen_sides(capture: Capture, cosine: np.ndarray) -> UnseenSides:
    """Unseen triangles look as their mirror images that are shown; those of scalp, neck and
    shoulders else as a shown one of their height, back and forth around the head; any other as the
    nearest connected ones. cosine: of `FrameStore.facing`."""
    views = _color_views(capture)
    is_outside = outside(capture)
    color, shown = mean_colors(capture, views)
    is_source = shown & is_outside & (cosine > SOURCE_COSINE)
    sources = np.flatnonzero(is_source)
    unseen = is_outside & (cosine < UNSEEN_COSINE)
    if not len(sources):
        return UnseenSides(np.zeros_like(unseen), color)
    found = color.copy()
    centers = np.asarray(capture.neutral)[capture.faces].mean(1)
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    for number in np.unique(part[unseen]):
        rows = np.flatnonzero(unseen & (part == number))
        own = sources[part[sources] == number] if (part[sources] == number).any() else sources
        _, near = cKDTree(centers[own]).query(centers[rows], min(SOURCE_TRIANGLES, len(own)))
        found[rows] = np.median(color[own[near.reshape(len(rows), -1)]], axis=1)
    at = head_coordinates(capture)
    kinds = {} if at is None else kinds_of(at, is_outside)
    for kind, members in kinds.items():
        own = np.flatnonzero(members & is_source)
        if kind == "scalp":
            own = hairy_triangles(own, centers, color, capture.regions)
        rows = np.flatnonzero(members & unseen)
        if at is not None and len(own) and len(rows):
            found[rows] = color[sources_around_head(at, own, rows)]
    hidden, partner = mirror_images(capture, unseen, is_source)
    found[hidden] = color[partner]
    inside = _unseen_inside(capture, shown, is_outside)
    found[inside] = inside_colors(capture, color, shown, inside)
    return UnseenSides(unseen | inside, found)


def _color_views(capture: Capture) -> list[View]:
    """Some views spread over all, and some of the timesteps in which the mouth is highest: a mouth
    that opens once is seen."""
    views = capture.views["train"]
    spread = evenly_spread(views, SPREAD_VIEWS)
    mouth = capture.regions.get("mouth")
    by_timestep = views_by_timestep(views)
    is_known = mouth is not None and mouth.any() and capture.flame is not None
    if not is_known or len(by_timestep) <= SPREAD_VIEWS:
        return spread
    lips = np.unique(capture.faces[mouth])
    height = {}
    for timestep in evenly_spread(list(by_timestep), FACING_TIMESTEPS):
        place = np.asarray(capture.mesh(timestep))[lips]
        height[timestep] = np.linalg.svd(place - place.mean(0), compute_uv=False)[1]
    highest = sorted(height, key=lambda timestep: -height[timestep])[:OPEN_VIEWS]
    opened = [by_timestep[timestep] for timestep in highest]
    return [*spread, *(own[len(own) // 2] for own in opened)]


def _unseen_inside(capture: Capture, shown: np.ndarray, is_outside: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles of the inside that no view shows, nor any neighbor of theirs. Teeth of
    which hardly any is shown count as unseen. None in a long recording whose meshes are files: not
    all of its mouths were looked for."""
    if capture.flame is None and len(capture.timesteps) > SPREAD_VIEWS:
        return np.zeros(len(shown), bool)
    touched = np.zeros(len(capture.neutral), bool)
    touched[capture.faces[shown]] = True
    inside = ~is_outside & ~touched[capture.faces].any(1)
    teeth = teeth_of(capture)
    if (teeth & shown).sum() < MIN_TEETH_SHARE * teeth.sum():
        inside |= teeth
    return np.asarray(inside)


def outside(capture: Capture) -> np.ndarray:
    """(F,) bool: triangles of the neutral mesh that some camera around it sees."""
    neutral = np.asarray(capture.neutral, np.float64)
    center = neutral.mean(0)
    radius = max(float(np.linalg.norm(neutral - center, axis=1).max()), 1e-9)
    seen = np.zeros(len(capture.faces), bool)
    focal = OUTSIDE_SIDE_PX * OUTSIDE_DISTANCE / 2.2
    for number in range(OUTSIDE_CAMERAS):
        angle = 2 * np.pi * number / OUTSIDE_CAMERAS
        height = (-0.5, 0.2, 0.9)[number % 3]
        eye = center + OUTSIDE_DISTANCE * radius * np.array([np.sin(angle), height, np.cos(angle)])
        camera = look_at(eye, center, OUTSIDE_SIDE_PX, OUTSIDE_SIDE_PX, focal_length=focal)
        triangle, _ = rasterize(neutral, capture.faces, camera)
        seen[np.unique(triangle[triangle >= 0])] = True
    return seen
