"""Adam with true freezing: a row that is not stepped keeps its value, its moments and its step count, bit for bit."""

from collections.abc import Mapping

import numpy as np

from ..raster.kernels.rows import adam_rows, count_steps
from .state import TrainState

BETA1, BETA2, EPSILON = np.float32(0.9), np.float32(0.999), np.float32(1e-15)


def step(state: TrainState, rows: np.ndarray, rates: Mapping[str, float]) -> None:
    """Step the listed rows (M,) int32 of every parameter along its gradient.

    rates: learning rate by parameter name; "sh_rest" is that of the view-dependent part of `sh`.
    (STGA, selective training; Adam with a step count per row, because rows are trained unequally often.)
    """
    correct1, correct2 = np.empty(len(rows), np.float32), np.empty(len(rows), np.float32)
    count_steps(rows, state.steps.numpy(), correct1, correct2, BETA1, BETA2)
    for name, parameter in state.parameters._asdict().items():
        tensors = (parameter, *(getattr(part, name) for part in (state.gradients, state.first, state.second)))
        flat = [t.numpy().reshape(len(state), -1) for t in tensors]
        by_column = np.full(flat[0].shape[1], rates[name], np.float32)
        if name == "sh":
            by_column[3:] = rates["sh_rest"]
        adam_rows(rows, *flat, correct1, correct2, by_column, BETA1, BETA2, EPSILON)
