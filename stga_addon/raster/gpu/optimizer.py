"""Adam on the wanted rows only, with the limits of size and distance, on the device."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..cpu.layout import Parameters
from .device import Device, Recording
from .layout import WORKGROUP

INCLUDE = ("numbers", "optimizer")
RATES = (*Parameters._fields, "sh_rest")
"""Learning rates in the order of the kernels; the last is that of the harmonics above the constant one."""
STEP = np.dtype(
    [("rates", np.float32, 8)]
    + [(name, np.float32) for name in ("beta1", "beta2", "log_beta1", "log_beta2", "epsilon", "ema_share")]
    + [(name, np.float32) for name in ("scale_weight", "distance_weight", "opacity_weight")]
    + [(name, np.uint32) for name in ("statistics", "triangles", "padding")]
)
"""The uniform `step` of optimizer.wgsl."""


class OptimizerTables(NamedTuple):
    """Tables of N splats in training, on the device.

    first, second, average  shaped as the table of splats
    history  (N, 3) steps uint32, sum of the screen gradients and number of summands float32
    traits   (N, 2) float32: 1 for unbound splats, else 0; share of the cameras that did not see them
    limits   (F, 3) float32: largest scale of bound and of unbound splats, largest distance
    """

    first: Any
    second: Any
    average: Any
    history: Any
    traits: Any
    limits: Any


def upload_step(
    device: Device,
    rates: Mapping[str, float],
    betas: tuple[float, float],
    epsilon: float,
    ema_share: float,
    weights: tuple[float, float, float],
    statistics: bool,
    triangles: int = 0,
) -> None:
    """Send the numbers of the next step.

    rates by name; ema_share: least share of a step in the exponential moving average; weights: of the limits of scale,
    distance and, divided by the number of splats, opacity; statistics: collect the screen gradients; triangles:
    whose splats driven offsets move.
    """
    step = np.zeros(1, STEP)
    step["rates"][0, : len(RATES)] = [rates[name] for name in RATES]
    step["beta1"], step["beta2"] = betas
    step["log_beta1"], step["log_beta2"] = (math.log(beta) for beta in betas)
    step["epsilon"], step["ema_share"], step["statistics"] = epsilon, ema_share, statistics
    step["triangles"] = triangles
    step["scale_weight"], step["distance_weight"], step["opacity_weight"] = weights
    device.upload("step", step, "uniform")


def optimize(
    work: Recording, count: int, stride: int, tables: OptimizerTables, limited: bool, *, view: Any, splats: Any,
    gradients: Any, face: Any, wanted: Any, screen: Any,
) -> None:  # fmt: skip
    """Record a step of the wanted rows of `count` splats of `stride` words, with the numbers uploaded last.

    limited: whether a limit of scale or distance has a weight. screen (N,): of `project_backward`. The gradients are
    changed by those of the limits.
    """
    device = work.device
    shared = {"view": view, "wanted": wanted, "splats": splats}
    step, corrections = device.buffer("step", STEP.itemsize // 4, "uniform"), device.buffer("corrections", 4 * count)
    constant = {"face": face, "traits": tables.traits, "limits": tables.limits, "norms": device.buffer("norms", 2)}
    if limited:
        groups = -(-count // WORKGROUP)
        buffers = {**shared, **constant, "excess": device.buffer("excess", 4 * groups)}
        work.dispatch(device.kernel("limits", "measure", INCLUDE[:1]), device.groups(count), **buffers)
        work.dispatch(device.kernel("limits", "total", INCLUDE[:1]), (1, 1, 1), **buffers)
    work.dispatch(
        device.kernel("rows", include=INCLUDE), device.groups(count), **shared, **constant, step=step, screen=screen,
        gradients=gradients, history=tables.history, corrections=corrections,
    )  # fmt: skip
    work.dispatch(
        device.kernel("adam", include=INCLUDE), device.groups(count * stride), **shared, step=step,
        gradients=gradients, corrections=corrections, first=tables.first, second=tables.second,
        average=tables.average,
    )  # fmt: skip


def compile_kernels(device: Device) -> None:
    """Compile what this module dispatches."""
    for entry in ("measure", "total"):
        device.kernel("limits", entry, INCLUDE[:1])
    for name in ("rows", "adam"):
        device.kernel(name, include=INCLUDE)
