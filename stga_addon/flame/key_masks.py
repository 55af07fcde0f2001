"""Masks of eyes, lips and nose for FLAME's mesh, found on it where they come with no file.

They stand in for those of FLAME_masks.pkl, which not everyone has, under the same names.
"""

from collections.abc import Sequence

import numpy as np

from .quaternions import unit
from .teeth import TEMPLATE_VERTICES, holes_of, mouth_rings

EYEBALLS = (3931, 4477, TEMPLATE_VERTICES)
"""Index layout: the first vertices of FLAME's left eyeball, after the skin, and of its right one,
and the end of that."""
EYE_REGION_RADII = 2.0
"""Radius of an eye's region, in radii of the eyeball."""
LIP_HEIGHT_FRACTION = 0.18
"""Height of lips from the line where they meet, as a fraction of the width of the mouth."""
NOSE_RADIUS_FRACTION = 0.35
"""Radius of a nose around the line from between the eyes to its tip, as a fraction of the eyes'
height over the mouth."""
MIDDLE_FRACTION = 0.1
"""Half the width of the middle of a face, as a fraction of the eyes' distance."""
RIDGE_POINTS = 9
"""Points on the ridge of a nose, from the tip to between the eyes."""
NECK_TILT = np.radians(29.3)
"""Radians between straight up and where the eyes are, seen from the end of FLAME's neck."""


def found_masks(vertices: np.ndarray, faces: np.ndarray) -> dict[str, np.ndarray]:
    """Masks of eyeballs, the regions around them, lips and nose of FLAME's mesh, with or without
    parts, posed and placed as it may be; none of a mesh without its two eyeballs. Raises StgaError
    for a mesh without an open mouth."""
    faces = faces[(faces < TEMPLATE_VERTICES).all(axis=1)]
    part = np.searchsorted(EYEBALLS, np.arange(TEMPLATE_VERTICES), side="right")
    corners = part[faces]
    if (corners.min(1) != corners.max(1)).any() or len(np.unique(corners)) < len(EYEBALLS):
        return {}
    skin = part == 0
    left, right = (np.flatnonzero(part == number) for number in (1, 2))
    at = _upright(vertices[:TEMPLATE_VERTICES], faces, left, right)
    _, lips = mouth_rings(at, faces)
    width = np.ptp(at[lips, 0])
    return {
        "left_eyeball": left,
        "right_eyeball": right,
        "left_eye_region": np.flatnonzero(skin & _around_eyeball(at, left)),
        "right_eye_region": np.flatnonzero(skin & _around_eyeball(at, right)),
        "lips": np.flatnonzero(skin & (_distance(at, at[lips]) < LIP_HEIGHT_FRACTION * width)),
        "nose": np.flatnonzero(skin & _on_nose(at, skin, (left, right, lips))),
    }


def _upright(at: np.ndarray, faces: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The vertices (V, 3), turned so that the head looks along z, y up, by its eyeballs and the end
    of its neck."""
    eyes = (at[left].mean(0) + at[right].mean(0)) / 2
    ends = [at[hole].mean(0) for hole in holes_of(faces)]
    if not ends:
        return at
    neck = max(ends, key=lambda end: float(np.linalg.norm(end - eyes)))
    across = unit(at[left].mean(0) - at[right].mean(0))
    along = eyes - neck
    along = unit(along - (along @ across) * across)
    forward = np.cross(across, along)
    up = np.cos(NECK_TILT) * along - np.sin(NECK_TILT) * forward
    return np.asarray((at - eyes) @ np.stack([across, up, np.cross(across, up)]).T)


def _around_eyeball(at: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """(V,) bool: vertices (V, 3) near to the eyeball's."""
    center = at[ball].mean(0)
    radius = np.linalg.norm(at[ball] - center, axis=1).max()
    return np.asarray(np.linalg.norm(at - center, axis=1) < EYE_REGION_RADII * radius)


def _on_nose(at: np.ndarray, skin: np.ndarray, around: Sequence[np.ndarray]) -> np.ndarray:
    """(V,) bool: vertices near to the ridge of the nose, from what lies foremost in the middle of
    the face; around: vertices of left and right eyeball, and of the lips."""
    left, right, mouth = (at[vertices].mean(0) for vertices in around)
    between = (left + right) / 2
    height = between[1] - mouth[1]
    middle = skin & (abs(at[:, 0] - between[0]) < MIDDLE_FRACTION * (left - right)[0])
    below = between[1] - at[:, 1]
    ridge = at[middle & (below > 0) & (below < height)]
    if not len(ridge):
        return np.zeros(len(at), bool)
    tip = ridge[ridge[:, 2].argmax()]
    root = ridge[ridge[:, 1].argmax()]
    line = np.linspace(tip, root, RIDGE_POINTS)
    return np.asarray(_distance(at, line) < NOSE_RADIUS_FRACTION * height)


def _distance(at: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(V,) of vertices (V, 3) from the nearest of the points."""
    return np.asarray(np.linalg.norm(at[:, None] - points, axis=2).min(1))
