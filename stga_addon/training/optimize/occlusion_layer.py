"""An opaque layer behind the surface, which blocks off-axis views: images make a head's sides
transparent where the tracked mesh is too wide, and a torso may have a front only."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...avatar.embedding import face_areas, face_frames
from ...avatar.lattice import NORMAL_AXIS
from .semantic_regions import (
    CHIN_LEVEL,
    TORSO_HEIGHT,
    HeadCoordinates,
    Region,
    nearest_rows,
    skin_of,
)
from .surface import Surface
from .unseen_sides import SOURCE_TRIANGLES, UnseenSides

GRAZED_COSINE = 0.7
"""A triangle has an occlusion layer behind it if the cosine between its normal and the camera that
it faces most is below this."""
FACE_ANGLE_DEG = 45.0
"""Angle from straight ahead, from the middle of the head, beyond which there is no face."""
ONE_DIRECTION_COSINE = 0.8
"""GRAZED_COSINE of a head that was filmed from one direction, along which its splats lie: off-axis
views would show the mouth's inside between them."""
ONE_DIRECTION_FACE_ANGLE_DEG = 30.0
"""FACE_ANGLE_DEG of such a head."""
CELL_VOXELS = 2
"""Side of the cell of a head's surface behind which one splat is enough."""
LARGEST_RATIO = 2.5
"""Side of the largest triangle with a splat behind it, in those of the median: one splat behind a
larger one, at a torso's corner, stands out as a spike."""
BORDER_CELLS = 2.0
"""Least distance of clothes' layer from the mesh's edge, where it would stand out."""
DEPTH_VOXELS = 0.5
"""Step between the depths at which the layer may lie."""
MAX_DEPTHS = 24
"""Depths that are tried; the first that lies within the masks is taken."""
MARGIN_FRACTION = 0.015
"""Least distance of the layer from the masks' edge, as a fraction of their height."""
BACK_MARGIN_FRACTION = 0.03
"""The same for a torso's back, whose triangles are large."""
SPLAT_REACH = 1.8
"""Three standard deviations of a splat, in sides of a square of two triangles, or in cells where
these are larger."""
BEHIND_DEG = (-30.0, 0.0, 30.0)
"""Directions from behind from which the inner side of a torso's front may show."""
BACK_FRACTION = 0.5
"""Depth of a back, an ellipse, as a fraction of half of the torso's width."""
BACK_LEVELS = 0.5
"""Height over which a torso's width and color are measured, in distances of the eyes from the
mouth."""
BACK_REACH = (0.02, 0.98)
"""Quantiles of the positions across a torso between which its width lies."""
BACK_GAP_VOXELS = 1.5
"""Depth of the back at the torso's sides."""
BACK_SIDE = 0.5
"""Distance from the middle, as a fraction of half of the width, from which a front has the color of
its back: a collar is lower in front than behind."""


@dataclass(frozen=True)
class OcclusionLayer:
    """The layer behind some triangles.

    triangles  (F,) bool: those behind which it has a splat
    places     (V, 3) meters: the neutral mesh's vertices, those of a torso's front in its back
    depth      (F,) meters: depth of the layer below these
    color      (F, 3) in 0…1 of the layer
    """

    triangles: np.ndarray
    places: np.ndarray
    depth: np.ndarray
    color: np.ndarray


def occlusion_layer(surface: Surface, sides: UnseenSides) -> OcclusionLayer:
    """Behind neck and clothes, and the outside of a head that few cameras see at a grazing angle or
    not at all, but for ears and the parts of the face: at the least depth that masks allow, in the
    off-axis color. Behind the front of a torso that has no back: a round one in the median color
    of its height."""
    faces = surface.capture.faces
    at = surface.at
    if at is None or not surface.has_few_cameras:
        nowhere = np.zeros(len(faces), bool)
        return OcclusionLayer(nowhere, surface.neutral, np.zeros(len(faces)), sides.off_axis)
    front, back, median_color = _back(surface, at, sides.color)
    of_back = np.zeros(len(back), bool)
    of_back[faces[front]] = True
    grazed, depth = _behind_sides(surface, at, ~of_back[faces].any(1))
    centers = surface.centers
    color = sides.off_axis.copy()
    color[front] = median_color
    skin = np.flatnonzero(grazed & ~sides.is_hair & ~surface.kinds["body"])
    if len(skin):
        around = nearest_rows(centers[skin], centers[skin], SOURCE_TRIANGLES)
        color[skin] = np.median(color[skin][around], axis=1)
    places = np.where(of_back[:, None], back, surface.neutral)
    triangles = _without_large(surface, grazed) | _without_large(surface, front)
    return OcclusionLayer(triangles, places, depth, color)


def _without_large(surface: Surface, triangles: np.ndarray) -> np.ndarray:
    """(F,) bool: these triangles (F,) bool, but for those larger than LARGEST_RATIO allows."""
    median = np.median(surface.areas[triangles]) if triangles.any() else 0.0
    return triangles & (surface.areas < LARGEST_RATIO**2 * median)


def _behind_sides(
    surface: Surface, at: HeadCoordinates, allowed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One triangle in each cell of those `allowed` (F,) bool that an off-axis view may look
    through, as (F,) bool: the triangles of `_grazed`, and of neck and clothes, because images need
    not make opaque what a collar or a fold hides from the cameras. And the depth (F,) in
    meters at which masks cover a triangle's layer; 0 where there is none."""
    allowed = allowed & surface.outside & skin_of(surface.capture)
    allowed &= ~surface.regions.within(Region.EAR)
    grazed = allowed & _grazed(surface, at)
    clothes = allowed & surface.kinds["body"] & _is_off_border(surface) & ~grazed
    rows = np.flatnonzero(grazed | clothes)
    depths = surface.voxel * DEPTH_VOXELS * np.arange(1, MAX_DEPTHS + 1)
    offsets = np.zeros((len(rows), len(depths), 3))
    offsets[:, :, NORMAL_AXIS["stga"]] = -depths
    fits = ~surface.beside_masks(rows, offsets, -MARGIN_FRACTION)
    large = clothes[rows]
    fits[large] &= ~_reaches_beside(surface, rows[large], offsets[large])
    lies_within = fits.any(1)
    rows = rows[lies_within]
    depth = np.zeros(len(allowed))
    depth[rows] = depths[fits[lies_within].argmax(1)]
    cells = np.floor(surface.centers[rows] / (CELL_VOXELS * surface.voxel))
    _, first = np.unique(cells, axis=0, return_index=True)
    chosen = np.zeros(len(allowed), bool)
    chosen[rows[first]] = True
    return chosen, depth


def _reaches_beside(surface: Surface, rows: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """(N, K) bool: whether a splat at one of the offsets (N, K, 3), as `beside_masks` has them,
    would show beside masks."""
    size = np.maximum(np.sqrt(2 * surface.areas[rows]), CELL_VOXELS * surface.voxel)
    plane = np.delete(np.eye(3), NORMAL_AXIS["stga"], axis=0)
    reach = SPLAT_REACH * size[:, None, None] * np.concatenate([plane, -plane])
    ends = [offsets + end[:, None] for end in reach.swapaxes(0, 1)]
    return np.any([surface.beside_masks(rows, offsets) for offsets in ends], axis=0)


def _grazed(surface: Surface, at: HeadCoordinates) -> np.ndarray:
    """(F,) bool: triangles of head and neck, without the face and up to an angle from straight
    ahead, that no camera sees well."""
    limit = GRAZED_COSINE
    angle_deg = FACE_ANGLE_DEG
    if surface.filmed_along is not None:
        limit = ONE_DIRECTION_COSINE
        angle_deg = ONE_DIRECTION_FACE_ANGLE_DEG
    beside = at.angle_deg > angle_deg
    beside |= surface.kinds["scalp"] | surface.kinds["body"]
    return np.asarray(beside & (surface.facing < limit) & (at.level > CHIN_LEVEL))


def _is_off_border(surface: Surface) -> np.ndarray:
    """(F,) bool: triangles that lie farther than BORDER_CELLS from the mesh's edge."""
    if not surface.border.any():
        return np.ones(len(surface.border), bool)
    distance, _ = cKDTree(surface.centers[surface.border]).query(surface.centers)
    return np.asarray(distance > BORDER_CELLS * CELL_VOXELS * surface.voxel)


def _open_front(surface: Surface, at: HeadCoordinates) -> np.ndarray:
    """(F,) bool: triangles of a torso whose inner side is visible from behind, except those that
    stick out of masks. A bust, which is short, has none."""
    across, _, ahead = at.axes
    front = np.zeros(len(surface.outside), bool)
    for angle in np.radians(BEHIND_DEG):
        visible, cosine = surface.visible_from(np.sin(angle) * across - np.cos(angle) * ahead)
        front |= visible & (cosine < 0)
    front &= (at.level < CHIN_LEVEL) & ~surface.sticks_out
    height = np.ptp(at.level[front]) if front.any() else 0.0
    return np.asarray(front & (height > TORSO_HEIGHT))


def _back(
    surface: Surface, at: HeadCoordinates, color: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles (F,) bool of a torso's open front whose places in the back lie within masks; the
    neutral vertices (V, 3), those of the front moved into the back; the back's colors (M, 3) behind
    these triangles. color (F, 3): of the front."""
    faces = surface.capture.faces
    neutral = surface.neutral
    front = _open_front(surface, at)
    if not front.any():
        return front, neutral, color[front]
    places, median_color = _round_back(surface, at, front, color)
    rows = np.flatnonzero(front)
    turned = face_frames(neutral, faces, neutral, "stga").rotation[rows]
    there = face_frames(places, faces, places, "stga")
    plane = np.delete(there.rotation[rows], NORMAL_AXIS["stga"], axis=2).swapaxes(1, 2)
    size = np.sqrt(2 * face_areas(places, faces[rows]))[:, None, None]
    reach = SPLAT_REACH * size * np.concatenate([plane, -plane], axis=1)
    center = there.origin[rows, None]
    points = np.concatenate([center, center + reach], axis=1)
    away = points - surface.centers[rows, None]
    offsets = np.einsum("nji,nkj->nki", turned, away)
    fits = ~surface.beside_masks(rows, offsets[:, :1], -BACK_MARGIN_FRACTION)[:, 0]
    fits &= ~surface.beside_masks(rows, offsets[:, 1:]).any(1)
    front[rows] = fits
    return front, places, median_color[fits]


def _round_back(
    surface: Surface, at: HeadCoordinates, front: np.ndarray, color: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The neutral vertices (V, 3), those of the triangles `front` (F,) bool moved into the back of
    an elliptic torso as wide as these; at each of these triangles' heights, the median color (M, 3)
    of the front's sides, of colors (F, 3)."""
    across, up, ahead = at.axes
    reach_m = BACK_LEVELS * at.unit
    places = surface.neutral.copy()
    vertices = np.unique(surface.capture.faces[front])
    triangles = surface.centers[front] - at.eyes
    width = triangles @ across
    level = triangles @ up

    def around(y: float) -> tuple[np.ndarray, float, float]:
        """Triangles (N,) bool near a height; the middle and the half of their width."""
        near = abs(level - y) < reach_m
        low, high = np.quantile(width[near] if near.any() else width, BACK_REACH)
        return near, (low + high) / 2, max((high - low) / 2, 1e-9)

    behind = np.empty(len(vertices))
    for row, (x, y) in enumerate((places[vertices] - at.eyes) @ np.stack([across, up], 1)):
        _, middle, half = around(y)
        beside = min(abs(x - middle) / half, 1)
        behind[row] = BACK_FRACTION * half * np.sqrt(1 - beside**2)
    behind += BACK_GAP_VOXELS * surface.voxel
    places[vertices] -= behind[:, None] * ahead
    median_color = np.empty((len(level), 3))
    for row, y in enumerate(level):
        near, middle, half = around(y)
        beside = near & (abs(width - middle) > BACK_SIDE * half)
        median_color[row] = np.median(color[front][beside if beside.any() else near], axis=0)
    return places, median_color
