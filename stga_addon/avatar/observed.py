"""Which sides of a head were filmed, and its avatar without the others."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..capture.mesh_geometry import head_axes, triangle_normals
from ..errors import StgaError
from ..flame.quaternions import unit
from .file import UNSEEN_REGION, Avatar

SECTOR_DEG = 10
"""Width of a sector of directions around the head, which is filmed or not as a whole."""
MAX_SLOPE = 0.5
"""Largest slope, up or down, of surfaces that count: steeper ones face no side."""
VISIBLE_TO_DEG = 90
"""Largest angle from a camera's direction at which it sees a surface."""
FROM_ALL_SIDES = "filmed from all sides"


def observed_sides(avatar: Avatar) -> str:
    """What training views looked at, as in "filmed from 50° on its right to 50° on its left; what
    is beyond is plausible"; "" where the avatar does not know it, or where its eyes and mouth
    are."""
    unseen = avatar.regions.get(UNSEEN_REGION)
    corners = np.asarray(avatar.neutral, np.float64)[avatar.faces]
    center = corners.mean(1)
    axes = head_axes(center, avatar.regions)
    if unseen is None or axes is None:
        return ""
    across, up, ahead = axes[1]
    normal = triangle_normals(corners)
    area = np.linalg.norm(normal, axis=1)
    normal = unit(normal, 1e-20)
    outwards = ((center - center.mean(0)) * normal).sum(1) > 0
    rows = np.flatnonzero(outwards & (np.abs(normal @ up) < MAX_SLOPE))
    angle = np.degrees(np.arctan2(normal[rows] @ across, normal[rows] @ ahead))
    sectors = 180 // SECTOR_DEG
    reach = []
    for side in (-1, 1):
        number = (side * angle // SECTOR_DEG).astype(int)
        is_side = number >= 0
        total, hidden = (
            np.bincount(number[is_side], weights[rows][is_side], sectors)[:sectors]
            for weights in (area, area * unseen)
        )
        dark = np.flatnonzero(hidden > total / 2)
        reach.append(dark[0] * SECTOR_DEG - VISIBLE_TO_DEG if len(dark) else None)
    if reach == [None, None]:
        return FROM_ALL_SIDES
    right_deg, left_deg = (VISIBLE_TO_DEG if end is None else max(0, int(end)) for end in reach)
    reached = f"{right_deg}° on its right to {left_deg}° on its left"
    return f"filmed from {reached}; what is beyond is plausible"


def observed_part(path: Path, avatar: Avatar) -> Avatar:
    """Without the splats on triangles that no camera saw, and colors as cameras saw them. Raises
    StgaError naming `path` where the avatar does not know them, or all are."""
    unseen = avatar.regions.get(UNSEEN_REGION)
    if unseen is None:
        problem = "does not state what was filmed, as files of older versions; train it again"
        raise StgaError(f"{path}: {problem}")
    avatar = avatar.as_trained
    kept = ~unseen[avatar.splats.face]
    if not kept.any():
        raise StgaError(f"{path}: has no splat on a triangle that was filmed")
    base = avatar.linear_base
    base = None if base is None else base[kept]
    return replace(avatar, splats=avatar.splats.rows(kept), linear_base=base)
