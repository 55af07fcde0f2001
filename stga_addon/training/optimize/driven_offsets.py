"""Training of driven offsets: how triangles' splats move with signals of the pose."""

from collections.abc import Callable, Mapping

import numpy as np

from ...avatar.offsets import OFFSETS
from ...raster.cpu.optimizer import AdamOptions, AdamTables, adam_rows, sum_by_triangle
from .adam import BETA1, BETA2
from .state import OffsetState


def step(
    states: Mapping[str, OffsetState],
    rows: np.ndarray,
    face: np.ndarray,
    xyz_gradient: np.ndarray,
    signal: Callable[[str], np.ndarray],
    position_rate: float,
    ema_share: float,
    epsilon: np.float32,
) -> None:
    """Adam step of the triangles face (N,) of the listed splats rows (M,), whose positions have
    xyz_gradient (N, 3).

    signal: name of an offset -> (F, S); position_rate: the splats'; ema_share, epsilon: as in
    `adam_rows`. A triangle moves all its splats alike, so its gradient is their sum.
    """
    for name, state in states.items():
        count = len(state.steps)
        total, trained = np.zeros((count, 3), np.float32), np.zeros(count, bool)
        sum_by_triangle(rows, face, xyz_gradient, total, trained)
        gradient = signal(name)[:, :, None] * total[:, None, :]
        rates = np.full(gradient[0].size, OFFSETS[name].rate_share * position_rate, np.float32)
        arrays = (state.value, gradient, state.first, state.second, state.average)
        tables = AdamTables._make([*(array.reshape(count, -1) for array in arrays), rates])
        options = AdamOptions(BETA1, BETA2, epsilon, np.float32(ema_share))
        adam_rows(np.flatnonzero(trained).astype(np.int32), state.steps, (tables,), options)
