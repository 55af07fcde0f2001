"""Driven offsets on the device: their signals, the move of the frames by them, and Adam on their coefficients."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from ...avatar.offsets import OFFSETS
from ...avatar.strain import AVERAGING_ROUNDS, STRAIN_COMPONENTS, StrainBasis
from .device import Device, Kernel, Recording
from .layout import list_words
from .optimizer import STEP

POSED, STEPPED = ("pose",), ("numbers", "optimizer")
"""Files that the kernels include."""


class Signal(Protocol):
    """Computes the signal of a driven offset of one mesh."""

    def __init__(self, device: Device, basis: StrainBasis) -> None: ...

    def record(self, work: Recording, pose: Any, strain_from_rest: Any) -> Any:
        """Record the signal of the pose whose strain (F, 3), less that at rest, is given; returns its table (F, S)."""

    @staticmethod
    def compile_kernels(device: Device) -> None:
        """Compile what `record` dispatches."""


class SmoothedStrain:
    """The signal of one mesh, whose neighborhood is uploaded once."""

    def __init__(self, device: Device, basis: StrainBasis) -> None:
        self._count = len(basis.faces)
        self._neighbors = device.upload("neighbors", list_words(basis.neighbors))
        self._rounds = [device.buffer(f"smoothed strain {n}", self._count * STRAIN_COMPONENTS) for n in range(2)]

    def record(self, work: Recording, pose: Any, strain_from_rest: Any) -> Any:
        """Record the signal of the pose whose strain (F, 3), less that at rest, is given; returns its table (F, 3)."""
        device, averaged = work.device, strain_from_rest
        for n in range(AVERAGING_ROUNDS):
            smoothed, averaged = averaged, self._rounds[n % 2]
            work.dispatch(
                device.kernel("smoothed_strain", include=POSED), device.groups(self._count), pose=pose,
                neighbors=self._neighbors, smoothed=smoothed, averaged=averaged,
            )  # fmt: skip
        return averaged

    @staticmethod
    def compile_kernels(device: Device) -> None:
        """Compile what `record` dispatches."""
        device.kernel("smoothed_strain", include=POSED)


SIGNALS: dict[str, type[Signal]] = {"strain_position": SmoothedStrain}
"""Driven offset -> what computes its signal; those without are trained on the CPU only."""


class OffsetTables(NamedTuple):
    """Tables of a driven offset of F triangles in training, on the device.

    value, first, second, average  (F, S, 3) float32 coefficients, Adam's moments and the exponential moving average
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


def shift(
    work: Recording, triangles: int, coefficients: Mapping[str, Any], signals: Mapping[str, Any], pose: Any, frames: Any
) -> None:
    """Record the move of the frames by offsets of these names; signals: of `Signal.record`."""
    device = work.device
    for name, table in coefficients.items():
        buffers = {"pose": pose, "coefficients": table, "driving": signals[name], "frames": frames}
        work.dispatch(_shift_kernel(device, name), device.groups(triangles), **buffers)


def step(
    work: Recording, triangles: int, tables: Mapping[str, OffsetTables], signals: Mapping[str, Any], *, view: Any,
    wanted: Any, gradients: Any,
) -> None:  # fmt: skip
    """Record a step of the triangles that have a wanted splat, with the numbers of `upload_step`.

    gradients: the splats', without those of the limits; signals: as in `shift`.
    """
    device = work.device
    uniform = device.buffer("step", STEP.itemsize // 4, "uniform")
    for name, table in tables.items():
        work.dispatch(
            _step_kernel(device, name), device.groups(triangles), **table._asdict(), view=view, step=uniform,
            wanted=wanted, gradients=gradients, driving=signals[name],
        )  # fmt: skip


def compile_kernels(device: Device) -> None:
    """Compile what this module dispatches."""
    for name, signal in SIGNALS.items():
        signal.compile_kernels(device)
        _shift_kernel(device, name)
        _step_kernel(device, name)


def _shift_kernel(device: Device, name: str) -> Kernel:
    return device.kernel("driven_offset", include=POSED, SIGNALS=OFFSETS[name].signals)


def _step_kernel(device: Device, name: str) -> Kernel:
    offset = OFFSETS[name]
    return device.kernel("driven_offset_step", include=STEPPED, SIGNALS=offset.signals, RATE_SHARE=offset.rate_share)
