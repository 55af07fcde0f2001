"""Adam with true freezing: a row that is not stepped keeps its value, its moments and its step count, bit for bit."""

from collections.abc import Mapping

import numpy as np

from ..raster.kernels.rows import adam_rows
from .state import TrainState

BETA1, BETA2, EPSILON = np.float32(0.9), np.float32(0.999), np.float32(1e-15)


def step(state: TrainState, rows: np.ndarray, rates: Mapping[str, float]) -> None:
    """Step the listed rows (M,) int32 of every parameter along its gradient.

    rates: learning rate by parameter name; "sh_rest" is that of the view-dependent part of `sh`.
    (STGA, selective training; Adam with a step count per row, because rows are trained unequally often.)
    """
    steps = state.steps.numpy()
    steps[rows] += 1
    for name, parameter in state.parameters._asdict().items():
        tensors = (parameter, *(getattr(part, name) for part in (state.gradients, state.first, state.second)))
        value, gradient, first, second = (t.numpy().reshape(len(state), -1) for t in tensors)
        # The view-dependent coefficients have a rate of their own.
        parts = [(slice(None), rates[name])]
        if name == "sh":
            parts = [(slice(0, 3), rates["sh"]), (slice(3, None), rates["sh_rest"])]
        for part, rate in parts:
            adam_rows(
                rows, value[:, part], gradient[:, part], first[:, part], second[:, part], steps,
                np.float32(rate), BETA1, BETA2, EPSILON,
            )  # fmt: skip
