"""Sparse Adam: rows that are not stepped keep values, moments and step count, bit for bit."""

from collections.abc import Mapping

import numpy as np

from ...capture.camera import Camera
from ...raster.cpu.optimizer import AdamOptions, adam_rows
from .state import TrainState

BETA1, BETA2, EPSILON = np.float32(0.9), np.float32(0.999), np.float32(1e-15)


def image_epsilon(share: float, camera: Camera) -> np.float32:
    """Adam's ε for gradients of a mean over an image's values, as a share of the weight of one of
    them."""
    return np.float32(share / (3 * camera.width * camera.height))


def step(
    state: TrainState,
    rows: np.ndarray,
    rates: Mapping[str, float],
    ema_share: float = 1.0,
    epsilon: np.float32 = EPSILON,
) -> None:
    """Step the listed rows (M,) int32 of every parameter along its gradient.

    rates      learning rate by parameter name; "sh_rest" is that of the view-dependent part of `sh`
    ema_share  least share of the stepped row in its exponential moving average; with 1, the average
               is the row
    epsilon    added to the root of the second moment; `image_epsilon` in training

    Steps are counted per row, because rows are trained unequally often (STGA, selective training).
    """
    for name, table in state.tables.items():
        table.rates[:] = rates[name]
        if name == "sh":
            table.rates[3:] = rates["sh_rest"]
    options = AdamOptions(BETA1, BETA2, epsilon, np.float32(ema_share))
    adam_rows(rows, state.steps, tuple(state.tables.values()), options)
