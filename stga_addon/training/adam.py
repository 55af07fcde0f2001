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
    np_steps = state.steps.numpy()
    np_steps[rows] += 1
    for name, parameter in state.parameters._asdict().items():
        arrays = [t[name].numpy() for t in (state.gradients._asdict(), state.first._asdict(), state.second._asdict())]
        flat = [a.reshape(len(a), -1) for a in (parameter.numpy(), *arrays)]
        if name == "sh":
            _step(rows, [a[:, :3] for a in flat], np_steps, rates["sh"])
            _step(rows, [a[:, 3:] for a in flat], np_steps, rates["sh_rest"])
        else:
            _step(rows, flat, np_steps, rates[name])


def _step(rows: np.ndarray, arrays: list[np.ndarray], steps: np.ndarray, rate: float) -> None:
    adam_rows(rows, *arrays, steps, np.float32(rate), BETA1, BETA2, EPSILON)
