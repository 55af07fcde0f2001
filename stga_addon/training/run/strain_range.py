"""Range of strain that a run has trained on, within which its avatar's colors and positions follow strain."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...avatar.file import Avatar, read_avatar
from ...avatar.strain import COLOR_RANGE, color_range, seen_range, strain_basis
from ...capture.model import Capture, evenly_spread
from ...errors import StgaError
from .folder import Continuation

MAX_TIMESTEPS = 64
"""Timesteps that are measured, evenly spread over those trained on."""


def trained_strain_range(
    capture: Capture, mesh: Callable[[int], np.ndarray], continuation: Continuation | None
) -> np.ndarray:
    """`Avatar.strain_range` (F, 2, 3) of a run: what its training timesteps show, and what its parent's did.

    mesh: timestep -> (V, 3) that is trained on. Within COLOR_RANGE.
    """
    limits = color_range(len(capture.faces))
    basis = strain_basis(capture.neutral, capture.faces, limits)
    timesteps = evenly_spread(sorted({view.timestep for view in capture.views["train"]}), MAX_TIMESTEPS)
    seen = seen_range(basis, (mesh(timestep) for timestep in timesteps))
    if continuation is None:
        return seen
    parent = read_avatar(continuation.parent / "avatar.npz")
    earlier = parent.strain_range
    if not parent.follows_strain:
        return seen  # it follows strain only from here on
    if earlier is None:
        return limits
    lowest, highest = np.minimum(seen[:, 0], earlier[:, 0]), np.maximum(seen[:, 1], earlier[:, 1])
    return np.stack([np.maximum(lowest, limits[:, 0]), np.minimum(highest, limits[:, 1])], axis=1)


def require_color_range(path: Path, avatar: Avatar) -> None:
    """Raise StgaError, naming the path, where an avatar follows strain beyond COLOR_RANGE.

    An earlier version trained it: more training would change it at once.
    """
    limits = avatar.strain_range
    if avatar.follows_strain and (
        limits is None or ((limits[:, 0] < COLOR_RANGE[0]) | (limits[:, 1] > COLOR_RANGE[1])).any()
    ):
        raise StgaError(f"{path}: colors follow strain as in an earlier version; train it anew")
