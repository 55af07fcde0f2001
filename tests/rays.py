"""Where rays meet triangles."""

import numpy as np


def distances(origin, direction, corners):
    """(…, F) distances, in lengths of the direction (…, 1, 3), at which rays meet triangles
    (F, 3, 3); NaN where they do not (Möller and Trumbore)."""
    a, b, c = corners.swapaxes(0, 1)
    first = b - a
    second = c - a
    across = np.cross(direction, second)
    offset = origin - a
    around = np.cross(offset, first)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (first * across).sum(-1)
        u = (offset * across).sum(-1) * scale
        v = (around * direction).sum(-1) * scale
        along = (second * around).sum(-1) * scale
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1), along, np.nan)
