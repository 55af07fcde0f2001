"""Sparse Adam, also of driven offsets: rows not stepped keep values, moments and step count."""

from collections.abc import Callable, Mapping

import numpy as np

from ...avatar.offsets import COLOR, OFFSETS, SCALE, DrivenOffset
from ...avatar.splats import MAX_SH_DEGREE, SH_C0
from ...capture.camera import Camera
from ...raster.cpu.optimizer import (
    AdamOptions,
    AdamTables,
    ColorStep,
    adam_rows,
    step_offset,
)
from ..settings import TrainingSettings
from .state import TrainState

PLAIN = AdamOptions(*map(np.float32, (0.9, 0.999, 1e-15, 0.0, 1.0)))
"""3D Gaussian Splatting's, without an average."""


def adam_options(settings: TrainingSettings, camera: Camera) -> AdamOptions:
    """Adam's options for gradients of a mean over an image's values: ε is a fraction of the weight
    of one value."""
    return PLAIN._replace(
        beta2=np.float32(settings.adam_beta2),
        epsilon=np.float32(settings.adam_epsilon / (3 * camera.width * camera.height)),
        ahead=np.float32(1) - PLAIN.beta1 if settings.adam_nesterov else np.float32(0),
        ema_share=np.float32(settings.ema_share),
    )


def color_step(
    state: TrainState,
    rates: Mapping[str, float],
    options: AdamOptions = PLAIN,
    sh_degree: int = MAX_SH_DEGREE,
) -> ColorStep:
    """How `render_backward` steps `sh`: its constant part at the rate "sh", its view-dependent part
    at "sh_rest". Coefficients of higher degrees than the one in use do not change."""
    tables = state.tables["sh"]
    tables.rates[:3] = rates["sh"]
    tables.rates[3:] = rates["sh_rest"]
    in_use = tables._replace(rates=tables.rates[: 3 * (sh_degree + 1) ** 2])
    return ColorStep(state.steps, in_use, options)


def step(
    state: TrainState,
    rows: np.ndarray,
    rates: Mapping[str, float],
    options: AdamOptions = PLAIN,
) -> None:
    """Step the listed rows (M,) int32 of every parameter but `sh` along its gradient, at its rate.

    Steps are counted per row, because rows are trained unequally often (STGA, selective training).
    """
    tables = {name: table for name, table in state.tables.items() if name != "sh"}
    for name, table in tables.items():
        table.rates[:] = rates[name]
    adam_rows(rows, state.steps, tuple(tables.values()), options)


def step_offsets(
    state: TrainState,
    rows: np.ndarray,
    signal: Callable[[DrivenOffset], np.ndarray],
    rates: Mapping[str, float],
    options: AdamOptions,
) -> None:
    """Adam step of the driven offsets of the triangles of the listed splats rows (M,), which have
    gradients.

    signal: what drives an offset, (F, 3); rates: the splats'. A triangle changes all its splats
    alike, so its gradient is their sum.
    """
    if not state.driven_offsets:
        return
    gradients = state.gradients
    stepped = np.zeros(len(state), bool)
    stepped[rows] = True
    moved = state.parameters.xyz, gradients.xyz, gradients.log_scale
    by_color = gradients.sh.reshape(len(state), -1)
    for name, driven in state.driven_offsets.items():
        offset = OFFSETS[name]
        is_color = offset.target == COLOR
        arrays = (driven.value, driven.value, driven.first, driven.second, driven.average)
        tables = [array.reshape(len(driven.steps), 9) for array in arrays]
        rate = np.full(9, offset.rate_fraction * rates[offset.rate], np.float32)
        step_offset(
            state.rows_by_triangle,
            stepped,
            (by_color if is_color else gradients.xyz, *moved),
            (offset.target == SCALE, np.float32(1 / SH_C0 if is_color else 1)),
            signal(offset),
            driven.steps,
            AdamTables._make([*tables, rate]),
            options,
        )
