"""Check of the principal point convention: does the tracked mesh lie inside the masks?"""

from collections.abc import Callable, Sequence
from importlib.util import find_spec

import numpy as np

from .camera import Camera
from .model import evenly_spread
from .transforms import PRINCIPAL_POINTS, Frame, with_principal_point

MAX_VIEWS = 4
MIN_SHARE_DIFFERENCE = 0.01  # of the vertices


def principal_point_warning(frames: Sequence[Frame], mesh: Callable[[int], np.ndarray], chosen: str) -> str | None:
    """A warning where another convention puts clearly more of the mesh inside the masks, else None.

    Checks a few views in which the conventions differ. Only vertices outside of a mask count: hair and shoulders lie
    inside the mask but beside the mesh. Without Pillow, which Blender lacks, nothing is checked.
    Raises StgaError where a mask cannot be read.
    """
    if find_spec("PIL") is None:
        return None
    apart = [frame for frame in frames if _conventions_differ(frame)]
    outside = [_shares_outside(frame, mesh) for frame in evenly_spread(apart, MAX_VIEWS)]
    known = [shares for shares in outside if shares is not None]
    if not known:
        return None
    share = dict(zip(PRINCIPAL_POINTS, np.mean(known, axis=0).tolist(), strict=True))
    best = min(share, key=lambda convention: share[convention])
    if share[chosen] < 2 * share[best] + MIN_SHARE_DIFFERENCE:
        return None
    return (
        f"{share[chosen]:.1%} of the mesh falls outside the masks with the principal point read as {chosen!r}, "
        f"but {share[best]:.1%} with {best!r}: the capture was probably written that way"
    )


def _cameras(frame: Frame) -> list[Camera]:
    return [with_principal_point(frame.view.camera, frame.principal, name) for name in PRINCIPAL_POINTS]


def _conventions_differ(frame: Frame) -> bool:
    points = np.array([(camera.cx, camera.cy) for camera in _cameras(frame)])
    return bool((np.ptp(points, axis=0) > 0.5).any())


def _shares_outside(frame: Frame, mesh: Callable[[int], np.ndarray]) -> list[float] | None:
    """Share of the vertices outside the mask under each convention, or None without a mask."""
    from .images import read_mask

    mask = read_mask(frame.view)
    if mask is None:
        return None
    points = mesh(frame.view.timestep)
    return [_share_outside(points, camera, mask) for camera in _cameras(frame)]


def _share_outside(points: np.ndarray, camera: Camera, mask: np.ndarray) -> float:
    pixels, depth = camera.project(points)
    column, row = np.floor(np.clip(pixels, -1, [camera.width, camera.height])).astype(int).T
    visible = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    inside = mask[row[visible], column[visible]] > 127
    return 1 - float(inside.sum()) / len(points)
