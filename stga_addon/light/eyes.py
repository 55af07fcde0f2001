"""Which parts of a mesh are eyeballs, whose highlights are sharp."""

import numpy as np

from ..capture.mesh_geometry import connected_parts

EYE_ROUGHNESS = 0.2
"""Of highlights on eyes: about as sharp as splats of half a millimeter on a ball of 12 mm can show."""
MIN_RADIUS_M, MAX_RADIUS_M = 0.007, 0.017
MAX_DEVIATION = 0.12
"""Share of the radius by which the vertices of an eyeball may leave the sphere, on average."""
MIN_VERTICES = 24


def wet_roughness(neutral: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) float32: EYE_ROUGHNESS on eyeballs, 0 elsewhere (skin).

    An eyeball is a part of its own that is nearly a sphere of an eye's size, as in FLAME and ICT-FaceKit.
    """
    part = connected_parts(len(neutral), faces)
    found = np.zeros(len(neutral), np.float32)
    used = np.zeros(len(neutral), bool)
    used[faces] = True
    for label in np.unique(part[used]):
        members = np.flatnonzero((part == label) & used)
        if len(members) >= MIN_VERTICES and _is_eyeball(neutral[members].astype(np.float64)):
            found[members] = EYE_ROUGHNESS
    return found


def _is_eyeball(points: np.ndarray) -> bool:
    """Whether points (M, 3) lie on a sphere of an eye's size (least squares)."""
    rows = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    found = np.linalg.lstsq(rows, (points**2).sum(1), rcond=None)[0]
    radius = np.sqrt(max(found[3] + found[:3] @ found[:3], 0))
    deviation = np.abs(np.linalg.norm(points - found[:3], axis=1) - radius).mean()
    return bool(MIN_RADIUS_M < radius < MAX_RADIUS_M and deviation < MAX_DEVIATION * radius)
