"""Training of how splats' positions follow the strain of their triangles."""

import numpy as np

from ...raster.cpu.optimizer import MAX_GRADIENT
from .adam import BETA1, BETA2
from .state import StrainPosition

RATE_SHARE = 0.5
"""Learning rate per unit of strain, as a share of that of the splats' positions."""


def step(
    state: StrainPosition,
    face: np.ndarray,
    xyz_gradient: np.ndarray,
    nearby: np.ndarray,
    position_rate: float,
    newest: float,
    epsilon: np.float32,
) -> None:
    """Adam step of the triangles face (M,) of the splats with gradients xyz_gradient (M, 3) of local positions.

    nearby (F, 3): `nearby_strain`; position_rate: the splats'; newest, epsilon: as in `adam_rows`, which also skips too
    large gradients. A triangle moves all its splats alike, so its gradient is their sum.
    """
    count = len(state.steps)
    touched = np.flatnonzero(np.bincount(face, minlength=count))
    moved = np.stack([np.bincount(face, column, count)[touched] for column in xyz_gradient.T], -1)
    gradient = nearby[touched][:, :, None] * moved.astype(np.float32)[:, None, :]
    valid = (np.abs(gradient) < MAX_GRADIENT).all((1, 2))
    touched, gradient = touched[valid], gradient[valid]
    state.steps[touched] += 1
    steps = state.steps[touched].astype(np.float64)
    first = BETA1 * state.first[touched] + (1 - BETA1) * gradient
    second = BETA2 * state.second[touched] + (1 - BETA2) * gradient**2
    rate = _per_triangle(RATE_SHARE * position_rate / (1 - float(BETA1) ** steps))
    root = np.sqrt(second) * _per_triangle(1 / np.sqrt(1 - float(BETA2) ** steps))
    value = state.value[touched] - rate * first / (root + epsilon)
    share = _per_triangle(np.maximum(newest, 4 / (steps + 3)))
    state.first[touched], state.second[touched], state.value[touched] = first, second, value
    state.average[touched] += share * (value - state.average[touched])


def _per_triangle(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32)[:, None, None]
