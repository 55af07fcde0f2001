"""Sparse Adam, also of driven offsets: rows not stepped keep values, moments and step count."""

from collections.abc import Callable, Mapping

import numpy as np

from ...avatar.offsets import COLOR, OFFSETS, SCALE
from ...avatar.splats import MAX_SH_DEGREE, SH_C0
from ...capture.camera import Camera
from ...raster.cpu.optimizer import (
    AdamOptions,
    AdamTables,
    ColorStep,
    adam_rows,
    offset_gradient,
    sum_by_triangle,
    sum_scale_gradient,
)
from ..settings import TrainingSettings
from .state import TrainState

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


def color_step(
    state: TrainState,
    rates: Mapping[str, float],
    options: AdamOptions = PLAIN,
    sh_degree: int = MAX_SH_DEGREE,
) -> ColorStep:
    """How `render_backward` steps `sh`: at the rate "sh", its view-dependent part at "sh_rest";
    coefficients of higher degrees than the one in use are left alone."""
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
    signal: Callable[[str], np.ndarray],
    rates: Mapping[str, float],
    options: AdamOptions,
) -> None:
    """Adam step of the driven offsets of the triangles of the listed splats rows (M,), which have
    gradients.

    signal: name of SIGNALS -> (F, 3); rates: the splats'. A triangle changes all its splats alike,
    so its gradient is their sum.
    """
    if not state.driven_offsets:
        return
    face = state.face
    gradients = state.gradients
    count = len(next(iter(state.driven_offsets.values())).steps)
    trained = np.zeros(count, bool)
    trained[face[rows]] = True
    # by target
    listed = np.flatnonzero(trained).astype(np.int32)
    totals = dict[str, np.ndarray]()
    for name, own in state.driven_offsets.items():
        offset = OFFSETS[name]
        if offset.target not in totals:
            total = totals[offset.target] = np.zeros((count, 3), np.float32)
            if offset.target == SCALE:
                moved = state.parameters.xyz, gradients.xyz, gradients.log_scale
                sum_scale_gradient(rows, face, *moved, total)
            else:
                by_splat = gradients.sh if offset.target == COLOR else gradients.xyz
                sum_by_triangle(rows, face, by_splat.reshape(len(face), -1), total)
        arrays = (own.value, np.empty_like(own.value), own.first, own.second, own.average)
        tables = [array.reshape(count, -1) for array in arrays]
        total = totals[offset.target]
        gradient = tables[1]
        per_unit = np.float32(1 / SH_C0 if offset.target == COLOR else 1)
        offset_gradient(listed, signal(offset.signal), total, per_unit, gradient)
        rate = np.full(gradient.shape[1], offset.rate_share * rates[offset.rate], np.float32)
        adam_rows(listed, own.steps, (AdamTables._make([*tables, rate]),), options)
