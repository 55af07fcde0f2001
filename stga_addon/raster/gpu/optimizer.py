"""Training on the device: (1 − w)·L1 + w·(1 − SSIM) of an image and its gradient; Adam on wanted
rows only, with the limits of size and distance, and on driven offsets."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ...avatar.offsets import COLOR, OFFSETS, SCALE
from ...avatar.splats import SH_C0
from ..cpu.layout import Parameters
from ..cpu.optimizer import AdamOptions
from ..cpu.rasterize import tile_grid
from .device import Device, Recording, entry_points
from .layout import SH, WORKGROUP, XYZ
from .rasterize import DEPTH_BITS, MAX_TILE_BITS, sort_passes

KERNEL_FILES = ("frames", "project", "tiles", "blend", "image_loss", "optimizer", "rows")
"""Files with the kernels of an iteration and of the work between two, beside those of `sort`."""
STEP_OFFSET = "optimizer.step_offset"
"""Kernel that any iteration may dispatch beside sorting and steps of driven offsets."""
RATES = (*Parameters._fields, "sh_rest", "strain_color")
"""Learning rates in the order of the kernels."""


def upload_target(
    device: Device,
    target: np.ndarray,
    ssim_weight: float,
    mask: np.ndarray | None = None,
    change: Any = (0, 0, 0),
) -> None:
    """Send the target (H, W, 3) uint8 of the next image, and how it is compared.

    mask (H, W) uint8: the foreground's coverage; where it leaves the background free, the target's
    color is changed by `change` (3,) in 0…255.
    """
    device.uniform("Loss", change=(*change, 0), ssim_weight=ssim_weight, masked=mask is not None)
    device.upload("image_target", target)
    if mask is not None:
        device.upload("mask", mask)


def image_loss(
    work: Recording, width: int, height: int, *, whole: bool, **given: Any
) -> tuple[Any, Any]:
    """Record the gradient of the loss of an image (3, H, W) against the uploaded target.

    given: view, image, and touched (tiles,), in which tiles the gradient is wanted; the image must
    be rendered LOSS_REACH_PX around them. Returns the gradient (3, H, W), undefined in other tiles,
    and the loss (1,), which is computed if `whole`: every tile is touched.
    """
    buffer = work.device.buffer
    (columns, rows) = tile_grid(width, height)
    v_image = buffer("v_image", 3 * width * height)
    result = buffer("result", 1)
    buffer("mask", 0)
    buffer("tile_sums", 6 * columns * rows)
    work.dispatch("image_loss.gradient", (columns, rows, 3), given)
    if whole:
        work.dispatch("image_loss.total", (1, 1, 1), given)
    return v_image, result


class OptimizerTables(NamedTuple):
    """Tables of N splats in training, on the device.

    first, second, average  shaped as the table of splats
    history  (N, 3) steps uint32, sum of the screen gradients and number of summands float32
    traits   (N, 2) float32: 1 for unbound splats, else 0; fraction of the cameras that did not see
             them
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
    options: AdamOptions,
    weights: tuple[float, float, float],
    statistics: bool,
    triangles: int = 0,
) -> None:
    """Send the numbers of the next step.

    rates by name; weights: of the limits of scale, distance and, divided by the number of
    splats, opacity; statistics: collect the screen gradients; triangles: whose splats driven
    offsets move.
    """
    scale_weight, distance_weight, opacity_weight = weights
    device.uniform(
        "Step",
        rates=np.reshape([*(rates[name] for name in RATES), 0], (2, 4)),
        **options._asdict(),
        log_beta1=math.log(options.beta1),
        log_beta2=math.log(options.beta2),
        scale_weight=scale_weight,
        distance_weight=distance_weight,
        opacity_weight=opacity_weight,
        statistics=statistics,
        triangles=triangles,
    )


def optimize(
    work: Recording, count: int, stride: int, limited: bool, tables: OptimizerTables, **given: Any
) -> None:
    """Record a step of the wanted rows of `count` splats of `stride` words, with the numbers
    uploaded last.

    limited: whether a limit of scale or distance has a weight. given: view, splats, face, wanted,
    gradients, which are changed by those of the limits, and screen, of `Rasterizer.backward`.
    """
    buffer = work.device.buffer
    all_tables = given | tables._asdict()
    buffer("corrections", 4 * count)
    buffer("norms", 2)
    buffer("excess", 4 * -(-count // WORKGROUP) if limited else 0)
    if limited:
        work.dispatch("optimizer.measure_excess", count, all_tables)
        work.dispatch("optimizer.join_excess", (1, 1, 1), all_tables)
    work.dispatch("optimizer.prepare", count, all_tables)
    work.dispatch("optimizer.adam", count * stride, all_tables)


class OffsetTables(NamedTuple):
    """Tables of a driven offset of F triangles in training, on the device.

    coefficients, first, second, average  (F, 3, 3) float32, with Adam's moments and the exponential
                                          moving average
    steps      (F,) uint32
    splats_of  `list_words` of the splats on each triangle
    """

    coefficients: Any
    first: Any
    second: Any
    average: Any
    steps: Any
    splats_of: Any


def step_offsets(
    work: Recording,
    triangles: int,
    offsets: Mapping[str, OffsetTables],
    signals: Mapping[str, Any],
    **given: Any,
) -> None:
    """Record a step of the triangles that have a wanted splat, with the numbers of `upload_step`.

    signals: of `Embedding`. given: view, wanted, and the splats' gradients, without those of the
    limits.
    """
    for name, tables in offsets.items():
        all_tables = {**given, **tables._asdict(), "driving": signals[OFFSETS[name].signal]}
        work.dispatch(STEP_OFFSET, triangles, all_tables, **offset_constants(name))


def offset_constants(name: str) -> dict[str, float]:
    """The constants of `step_offset` for a driven offset."""
    offset = OFFSETS[name]
    by_splat = {"TARGET": XYZ, "PER_UNIT": 1.0, "IS_SCALE": float(offset.target == SCALE)}
    if offset.target == COLOR:
        by_splat |= {"TARGET": SH, "PER_UNIT": 1 / SH_C0}
    return by_splat | {"RATE": RATES.index(offset.rate), "RATE_FRACTION": offset.rate_fraction}


def compile_kernels(device: Device) -> None:
    """Compile what an iteration of up to 2²² tiles dispatches, before the time that is given to
    training."""
    kernels = {f"{file}.{entry}" for file in KERNEL_FILES for entry in entry_points(file)}
    for kernel in sorted(kernels - {STEP_OFFSET}):
        device.kernel(kernel)
    for constants in (*sort_passes(DEPTH_BITS, False), *sort_passes(MAX_TILE_BITS, True)):
        for entry in ("count", "place", "scatter"):
            device.kernel(f"sort.{entry}", **constants)
    for name in OFFSETS:
        device.kernel(STEP_OFFSET, **offset_constants(name))
