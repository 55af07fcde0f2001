"""Range of strain that a run has trained on, within which its avatar's colors follow strain."""

from collections.abc import Callable, Sequence

import numpy as np

from ...avatar.file import read_avatar
from ...avatar.strain import color_range, seen_range, strain_basis
from ...capture.model import Capture
from .folder import Continuation

MAX_TIMESTEPS = 64
"""Timesteps that are measured, evenly spread over those trained on."""


def trained_strain_range(
    capture: Capture, mesh: Callable[[int], np.ndarray], continuation: Continuation | None
) -> np.ndarray:
    """`Avatar.strain_range` (F, 2, 3) of a run: what its training timesteps show, and what its parent's did.

    mesh: timestep -> (V, 3) that is trained on. Within COLOR_RANGE, which a parent of an earlier version may exceed.
    """
    limits = color_range(len(capture.faces))
    basis = strain_basis(capture.neutral, capture.faces, limits)
    seen = seen_range(basis, (mesh(timestep) for timestep in _measured(capture)))
    if continuation is None:
        return seen
    earlier = read_avatar(continuation.parent / "avatar.npz").strain_range
    if earlier is None:
        return limits
    lowest, highest = np.minimum(seen[:, 0], earlier[:, 0]), np.maximum(seen[:, 1], earlier[:, 1])
    return np.stack([np.maximum(lowest, limits[:, 0]), np.minimum(highest, limits[:, 1])], axis=1)


def _measured(capture: Capture) -> Sequence[int]:
    timesteps = sorted({view.timestep for view in capture.views["train"]})
    rows = np.linspace(0, len(timesteps) - 1, min(len(timesteps), MAX_TIMESTEPS)).round().astype(int)
    return [timesteps[row] for row in rows]
