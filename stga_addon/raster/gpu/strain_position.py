"""Adam on how splats' positions follow the strain of their triangles, on the device."""

from typing import Any, NamedTuple

import numpy as np

from .device import Device, Recording
from .optimizer import STEP

INCLUDE = ("numbers", "optimizer")


class StrainPositionTables(NamedTuple):
    """Tables of F triangles in training, on the device.

    value, first, second, average  (F, 3, 3) float32 coefficients, Adam's moments and the exponential moving average
    steps      (F,) uint32
    splats_of  of `splats_by_triangle`
    """

    value: Any
    first: Any
    second: Any
    average: Any
    steps: Any
    splats_of: Any


def splats_by_triangle(face: np.ndarray, triangles: int) -> np.ndarray:
    """(triangles + 1 + N,) the splats on each triangle, in order, behind where each one's begin in this same array.

    face (N,): the triangle of each splat.
    """
    by_triangle = np.argsort(face, kind="stable")
    start = np.searchsorted(face[by_triangle], np.arange(triangles + 1)) + triangles + 1
    return np.asarray(np.concatenate([start, by_triangle]), np.uint32)


def step(
    work: Recording, triangles: int, tables: StrainPositionTables, *, view: Any, wanted: Any, gradients: Any,
    smoothed: Any,
) -> None:  # fmt: skip
    """Record a step of the triangles that have a wanted splat, with the numbers of `upload_step`.

    gradients: the splats', without those of the limits; smoothed (F, 3): `smoothed_strain`.
    """
    device = work.device
    work.dispatch(
        device.kernel("strain_position", include=INCLUDE), device.groups(triangles), **tables._asdict(), view=view,
        step=device.buffer("step", STEP.itemsize // 4, "uniform"), wanted=wanted, gradients=gradients,
        smoothed=smoothed,
    )  # fmt: skip


def compile_kernels(device: Device) -> None:
    """Compile what this module dispatches."""
    device.kernel("strain_position", include=INCLUDE)
