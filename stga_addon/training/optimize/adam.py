"""Sparse Adam, also of driven offsets: rows not stepped keep values, moments and step count."""

from collections.abc import Callable, Mapping

import numpy as np

from ...avatar.offsets import OFFSETS
from ...avatar.splats import MAX_SH_DEGREE
from ...capture.camera import Camera
from ...raster.cpu.optimizer import AdamOptions, AdamTables, adam_rows, sum_by_triangle
from ..settings import TrainingSettings
from .state import OffsetState, TrainState

PLAIN = AdamOptions(*map(np.float32, (0.9, 0.999, 1e-15, 0.0, 1.0)))
"""3D Gaussian Splatting's, without an average."""


def adam_options(settings: TrainingSettings, camera: Camera) -> AdamOptions:
    """For gradients of a mean over an image's values: ε is a share of the weight of one of them."""
    return PLAIN._replace(
        beta2=np.float32(settings.adam_beta2),
        epsilon=np.float32(settings.adam_epsilon / (3 * camera.width * camera.height)),
        ahead=np.float32(1) - PLAIN.beta1 if settings.adam_nesterov else np.float32(0),
        ema_share=np.float32(settings.ema_share),
    )


def step(
    state: TrainState,
    rows: np.ndarray,
    rates: Mapping[str, float],
    options: AdamOptions = PLAIN,
    sh_degree: int = MAX_SH_DEGREE,
) -> None:
    """Step the listed rows (M,) int32 of every parameter along its gradient.

    rates      learning rate by parameter name; "sh_rest" is that of the view-dependent part of `sh`
    sh_degree  in use: coefficients of higher ones have no gradient, and memory is left alone

    Steps are counted per row, because rows are trained unequally often (STGA, selective training).
    """
    tables = dict(state.tables)
    for name, table in tables.items():
        table.rates[:] = rates[name]
    sh_rates = tables["sh"].rates
    sh_rates[3:] = rates["sh_rest"]
    tables["sh"] = tables["sh"]._replace(rates=sh_rates[: 3 * (sh_degree + 1) ** 2])
    adam_rows(rows, state.steps, tuple(tables.values()), options)


def step_offsets(
    states: Mapping[str, OffsetState],
    rows: np.ndarray,
    face: np.ndarray,
    xyz_gradient: np.ndarray,
    signal: Callable[[str], np.ndarray],
    position_rate: float,
    options: AdamOptions,
) -> None:
    """Adam step of the triangles face (N,) of the listed splats rows (M,), whose positions have
    xyz_gradient (N, 3).

    signal: name of an offset -> (F, S); position_rate: the splats'. A triangle moves all its
    splats alike, so its gradient is their sum.
    """
    for name, state in states.items():
        count = len(state.steps)
        total, trained = np.zeros((count, 3), np.float32), np.zeros(count, bool)
        sum_by_triangle(rows, face, xyz_gradient, total, trained)
        gradient = signal(name)[:, :, None] * total[:, None, :]
        rates = np.full(gradient[0].size, OFFSETS[name].rate_share * position_rate, np.float32)
        arrays = (state.value, gradient, state.first, state.second, state.average)
        tables = AdamTables._make([*(array.reshape(count, -1) for array in arrays), rates])
        adam_rows(np.flatnonzero(trained).astype(np.int32), state.steps, (tables,), options)
