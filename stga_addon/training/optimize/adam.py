"""Sparse Adam, also of driven offsets: rows not stepped keep values, moments and step count."""

from collections.abc import Callable, Mapping

import numpy as np

from ...avatar.offsets import OFFSETS
from ...avatar.splats import MAX_SH_DEGREE
from ...capture.camera import Camera
from ...raster.cpu.optimizer import AdamOptions, AdamTables, adam_rows, sum_by_triangle
from .state import OffsetState, TrainState

BETA1, EPSILON = np.float32(0.9), np.float32(1e-15)


def image_epsilon(share: float, camera: Camera) -> np.float32:
    """Adam's ε for gradients of a mean over an image's values, as a share of the weight of one of
    them."""
    return np.float32(share / (3 * camera.width * camera.height))


def step(
    state: TrainState,
    rows: np.ndarray,
    rates: Mapping[str, float],
    beta2: float = 0.999,
    ema_share: float = 1.0,
    epsilon: np.float32 = EPSILON,
    sh_degree: int = MAX_SH_DEGREE,
) -> None:
    """Step the listed rows (M,) int32 of every parameter along its gradient.

    rates      learning rate by parameter name; "sh_rest" is that of the view-dependent part of `sh`
    beta2      decay of the second moment
    ema_share  least share of the stepped row in its exponential moving average; with 1, the average
               is the row
    epsilon    added to the root of the second moment; `image_epsilon` in training
    sh_degree  in use: coefficients of higher ones have no gradient, and memory is left alone

    Steps are counted per row, because rows are trained unequally often (STGA, selective training).
    """
    tables = dict(state.tables)
    for name, table in tables.items():
        table.rates[:] = rates[name]
    sh_rates = tables["sh"].rates
    sh_rates[3:] = rates["sh_rest"]
    tables["sh"] = tables["sh"]._replace(rates=sh_rates[: 3 * (sh_degree + 1) ** 2])
    options = AdamOptions(BETA1, np.float32(beta2), epsilon, np.float32(ema_share))
    adam_rows(rows, state.steps, tuple(tables.values()), options)


def step_offsets(
    states: Mapping[str, OffsetState],
    rows: np.ndarray,
    face: np.ndarray,
    xyz_gradient: np.ndarray,
    signal: Callable[[str], np.ndarray],
    position_rate: float,
    beta2: float,
    ema_share: float,
    epsilon: np.float32,
) -> None:
    """Adam step of the triangles face (N,) of the listed splats rows (M,), whose positions have
    xyz_gradient (N, 3).

    signal: name of an offset -> (F, S); position_rate: the splats'; beta2, ema_share, epsilon: as
    in `step`. A triangle moves all its splats alike, so its gradient is their sum.
    """
    for name, state in states.items():
        count = len(state.steps)
        total, trained = np.zeros((count, 3), np.float32), np.zeros(count, bool)
        sum_by_triangle(rows, face, xyz_gradient, total, trained)
        gradient = signal(name)[:, :, None] * total[:, None, :]
        rates = np.full(gradient[0].size, OFFSETS[name].rate_share * position_rate, np.float32)
        arrays = (state.value, gradient, state.first, state.second, state.average)
        tables = AdamTables._make([*(array.reshape(count, -1) for array in arrays), rates])
        options = AdamOptions(BETA1, np.float32(beta2), epsilon, np.float32(ema_share))
        adam_rows(np.flatnonzero(trained).astype(np.int32), state.steps, (tables,), options)
