"""Optimizer kernels: Adam on listed rows only, and the limits of scale and distance."""

import math
from typing import Any, NamedTuple

import numpy as np

from . import jit, part_jit
from .elementary import exponential
from .threads import call_helpers, end_stages, parallel, pieces, stage

ROWS_PER_BLOCK = 256
"""Rows that a thread steps at a time."""
ROWS_PER_SUM = 1024
"""Rows that are summed by one thread, so that a sum does not depend on how many threads there
are."""
MAX_GRADIENT = np.float32(1e18)
"""A row with a larger gradient is skipped: its square would make the second moment infinite, and
the row NaN."""
ZERO = np.float32(0.0)
ONE = np.float32(1.0)


class AdamTables(NamedTuple):
    """A parameter in training: its values (N, D) float32 and, of the same shape, what Adam keeps
    for them.

    gradient, first, second, average  first and second moment, and the exponential moving average of
                                      the values
    rates  (C,) float32 learning rates of the first C columns; the others are not stepped
    """

    value: Any
    gradient: Any
    first: Any
    second: Any
    average: Any
    rates: Any


class AdamOptions(NamedTuple):
    """Adam's constants, all float32.

    ahead      by how much of the way from the first moment to the gradient a step goes; 0: Adam;
               1 − beta1: Nesterov's momentum (Dozat 2016); bias correction makes the first step
               as long as Adam's
    ema_share  least fraction of a step in the exponential moving average; with 1, the average is
               the row
    """

    beta1: np.float32
    beta2: np.float32
    epsilon: np.float32
    ahead: np.float32
    ema_share: np.float32


class ColorStep(NamedTuple):
    """How `project.project_backward` steps the harmonics' coefficients, whose gradients are never
    all in memory: steps (N,) int32 made before, and tables as of `adam_rows`. Without rates it
    steps nothing."""

    steps: Any
    tables: AdamTables
    options: AdamOptions


@parallel(lambda rows, *_: len(rows), piece=ROWS_PER_BLOCK)
def adam_rows(work, rows, steps, parameters, options):
    """One Adam step on the listed rows (M,) of several parameters, with each row's own step count.

    parameters: tuple of AdamTables; steps (N,) int32; options: AdamOptions. The stepped value
    enters its exponential moving average with the fraction `ema_share`, or 4 / (steps + 3) where
    that is more, because the first steps are long. Rows that are not listed are not touched at all.
    A row whose gradient is not finite, or beyond MAX_GRADIENT, keeps that parameter, its moments
    and its average. All parameters at once: every further parallel loop waits for its slowest
    thread.
    """
    call_helpers(work)
    corrections = np.empty((3, ROWS_PER_BLOCK), np.float32)
    for begin, end in pieces(work):
        some = rows[begin:end]
        correct_bias(some, steps, options, corrections)
        for n in range(len(some)):
            steps[some[n]] += 1
        for p in range(len(parameters)):
            adam_block(some, some, parameters[p], parameters[p].gradient, corrections, options)


@part_jit
def correct_bias(rows, steps, options, corrections):
    """Write to corrections (3, ≥ M) what each listed row's next step multiplies the moments by, the
    second one's root, and the fraction with which the stepped value enters its average."""
    log1 = math.log(options.beta1)
    log2 = math.log(options.beta2)
    latest = np.int32(-1)
    first = ZERO
    second = ZERO
    fraction = ZERO
    for n in range(len(rows)):
        if steps[rows[n]] != latest:  # neighbors are mostly trained equally often
            latest = steps[rows[n]]
            count = np.float64(latest + 1)
            first = np.float32(1.0 / (1.0 - (1.0 - options.ahead) * math.exp(count * log1)))
            second = np.float32(1.0 / math.sqrt(1.0 - math.exp(count * log2)))
            fraction = np.float32(max(np.float64(options.ema_share), 4.0 / (count + 3.0)))
        corrections[0, n] = first
        corrections[1, n] = second
        corrections[2, n] = fraction


@part_jit
def adam_block(rows, places, parameter, gradient, corrections, options):
    """Adam on a few rows of one parameter, whose gradients are at `places` of gradient; a function
    of its own so that LLVM sees plain arrays and vectorizes."""
    values, _, first, second, average, rates = parameter
    beta1, beta2, epsilon, ahead, _ = options
    width = len(rates)
    for n in range(len(rows)):
        i = rows[n]
        at = places[n]
        invalid = ZERO
        for c in range(width):
            invalid += ZERO if abs(gradient[at, c]) < MAX_GRADIENT else ONE
        if invalid != ZERO:
            continue
        scale1 = corrections[0, n]
        scale2 = corrections[1, n]
        fraction = corrections[2, n]
        for c in range(width):
            g = gradient[at, c]
            m = beta1 * first[i, c] + (ONE - beta1) * g
            v = beta2 * second[i, c] + (ONE - beta2) * g * g
            first[i, c] = m
            second[i, c] = v
            m += ahead * (g - m)
            value = values[i, c] - rates[c] * m * scale1 / (math.sqrt(v) * scale2 + epsilon)
            values[i, c] = value
            average[i, c] += fraction * (value - average[i, c])


@parallel(lambda rows, *_: len(rows), piece=16_384)
def add_screen_gradients(work, rows, screen_gradient, total, count):
    """Add screen_gradient (N,) of the listed rows (M,) to total (N,), and 1 to their count (N,)."""
    call_helpers(work)
    for first_row, past_row in pieces(work):
        for n in range(first_row, past_row):
            i = np.uint64(rows[n])
            total[i] += screen_gradient[i]
            count[i] += ONE


@parallel(lambda lists, *_: len(lists[0]) - 1, piece=ROWS_PER_BLOCK)
def step_offset(work, lists, stepped, sources, kind, signal, steps, parameter, options):
    """One Adam step of a driven offset's coefficients on the triangles that have a splat among the
    `stepped` (N,) bool; other triangles are not touched at all.

    lists: `layout.rows_by_triangle`, of F triangles. sources: a tuple of `sum_of_triangle`'s arrays
    (N, ·). kind: a tuple of whether the target is the scale, and of what the gradient is multiplied
    by. signal (F, 3) drives the offset; steps (F,) int32 and parameter: AdamTables (F, 9), whose
    gradient is not used.
    """
    call_helpers(work)
    per_unit = kind[1]
    total = np.empty(3, np.float32)
    gradient = np.empty((ROWS_PER_BLOCK, 9), np.float32)
    corrections = np.empty((3, ROWS_PER_BLOCK), np.float32)
    triangles = np.empty(ROWS_PER_BLOCK, np.int32)
    places = np.arange(ROWS_PER_BLOCK).astype(np.int32)
    for begin, end in pieces(work):
        count = 0
        for f in range(begin, end):
            if sum_of_triangle(f, lists, stepped, sources, kind[0], total):
                for k in range(3):
                    factor = per_unit * signal[f, k]
                    for c in range(3):
                        gradient[count, 3 * k + c] = factor * total[c]
                triangles[count] = f
                count += 1
        trained = triangles[:count]
        correct_bias(trained, steps, options, corrections)
        for n in range(count):
            steps[trained[n]] += 1
        adam_block(trained, places[:count], parameter, gradient, corrections, options)


@part_jit
def sum_of_triangle(f, lists, stepped, sources, is_scale, total):
    """Write to total (3,) the sum of the first three columns of sources[0] over a triangle's
    stepped splats; or, first, the gradient of the logarithm of its frame's scale, from positions
    and the gradients of positions and of the logarithms of scales, sources[1:]. Returns whether
    there is such a splat."""
    starts, rows = lists
    gradient, xyz, v_xyz, v_log_scale = sources
    is_any = False
    total[:] = ZERO
    for n in range(starts[f], starts[f + 1]):
        i = rows[n]
        if stepped[i]:
            is_any = True
            for c in range(3):
                if is_scale:
                    total[0] += xyz[i, c] * v_xyz[i, c] + v_log_scale[i, c]
                else:
                    total[c] += gradient[i, c]
    return is_any


@jit
def add_frame_gradients(rows, face, xyz, rotation, v_xyz, v_rotation, v_log_scale, total):
    """Add to total (F, 7) float64, of the listed rows' (M,) triangles, the gradient that moving all
    splats of a triangle alike has: of their translation (3) and rotation (3) in the triangle's
    axes and local units, and of the logarithm of their scale."""
    for n in range(len(rows)):
        i = rows[n]
        f = face[i]
        x = np.float64(xyz[i, 0])
        y = np.float64(xyz[i, 1])
        z = np.float64(xyz[i, 2])
        fx = v_xyz[i, 0]
        fy = v_xyz[i, 1]
        fz = v_xyz[i, 2]
        q0 = rotation[i, 0]
        q1 = rotation[i, 1]
        q2 = rotation[i, 2]
        q3 = rotation[i, 3]
        v0 = v_rotation[i, 0]
        v1 = v_rotation[i, 1]
        v2 = v_rotation[i, 2]
        v3 = v_rotation[i, 3]
        total[f, 0] += fx
        total[f, 1] += fy
        total[f, 2] += fz
        # of position (cross product), plus of orientation (half of the quaternion's gradient)
        total[f, 3] += y * fz - z * fy + (q0 * v1 - q1 * v0 + q2 * v3 - q3 * v2) / 2
        total[f, 4] += z * fx - x * fz + (q0 * v2 - q2 * v0 + q3 * v1 - q1 * v3) / 2
        total[f, 5] += x * fy - y * fx + (q0 * v3 - q3 * v0 + q1 * v2 - q2 * v1) / 2
        scaled = v_log_scale[i, 0] + v_log_scale[i, 1] + v_log_scale[i, 2]
        total[f, 6] += x * fx + y * fy + z * fz + scaled


def scale_limit(
    rows: np.ndarray,
    log_scale: np.ndarray,
    face: np.ndarray,
    unbound: np.ndarray,
    limits: np.ndarray,
    weight: float,
    gradient: np.ndarray,
) -> float:
    """weight · ‖ReLU(scale − limit)‖₂ over the listed rows; its gradient is added to gradient (N,
    3).

    limits (2, F) per triangle, of bound and of unbound splats, in the unit of the splats' local
    scale. Returns the norm.
    """
    sums = np.zeros(-(-len(rows) // ROWS_PER_SUM) + 1)
    limit_scale(rows, log_scale, face, unbound, limits, weight, gradient, sums)
    return float(sums[-1])


@parallel(lambda rows, *_: len(rows), piece=4 * ROWS_PER_SUM)
def limit_scale(work, rows, log_scale, face, unbound, limits, weight, gradient, sums):
    """`scale_limit`; writes to sums Σ ReLU(scale − limit)² over ROWS_PER_SUM rows each, and as the
    last one the norm."""
    call_helpers(work)
    scales = np.empty(3 * ROWS_PER_SUM, np.float32)
    parts = len(sums) - 1
    for k in stage(work, 0, parts):
        some = rows[k * ROWS_PER_SUM : (k + 1) * ROWS_PER_SUM]
        sums[k] = _excess_scale(some, log_scale, face, unbound, limits, scales)
    for _ in stage(work, 1, 1):
        total = 0.0
        for k in range(parts):
            total += sums[k]
        sums[parts] = math.sqrt(total)
    if sums[parts] > 0.0:
        factor = np.float32(weight / sums[parts])
        for k in stage(work, 2, parts):
            for i in rows[k * ROWS_PER_SUM : (k + 1) * ROWS_PER_SUM]:
                limit = limits[1 if unbound[i] else 0, face[i]]
                for c in range(3):
                    scale = math.exp(log_scale[i, c])
                    gradient[i, c] += factor * max(ZERO, scale - limit) * scale
    end_stages(work)


@part_jit
def _excess_scale(rows, log_scale, face, unbound, limits, scales):
    """Σ ReLU(scale − limit)² over a few rows; scales: room for theirs."""
    for n in range(np.uint64(len(rows))):
        i = np.uint64(rows[n])
        for c in range(np.uint64(3)):
            scales[np.uint64(3) * n + c] = log_scale[i, c]
    for n in range(np.uint64(3 * len(rows))):
        scales[n] = exponential(scales[n])
    total = 0.0
    for n in range(np.uint64(len(rows))):
        i = np.uint64(rows[n])
        limit = limits[1 if unbound[i] else 0, face[i]]
        for c in range(np.uint64(3)):
            excess = max(ZERO, scales[np.uint64(3) * n + c] - limit)
            total += excess * excess
    return total


@parallel(lambda rows, *_: len(rows), piece=16_384)
def opacity_weight(work, rows, opacity, fraction, weight, gradient):
    """weight · Σ fraction · sigmoid(opacity) over the listed rows; its gradient is added to
    gradient (N,).

    fraction (N,) float32.
    """
    call_helpers(work)
    for first_row, past_row in pieces(work):
        for n in range(first_row, past_row):
            i = rows[n]
            if fraction[i] != ZERO:  # bound splats have none
                value = ONE / (ONE + math.exp(-opacity[i]))
                gradient[i] += np.float32(weight) * fraction[i] * value * (ONE - value)


@jit
def distance_limit(rows, xyz, face, unbound, limit, weight, gradient):
    """weight · ‖ReLU(|xyz| − limit)‖₂ over the listed rows; its gradient is added to gradient (N,
    3).

    limit (F,) per triangle in local units. Unbound splats have no limit. Returns the norm.
    """
    total = 0.0
    for n in range(len(rows)):
        i = rows[n]
        if not unbound[i]:
            over = max(ZERO, _length(xyz[i]) - limit[face[i]])
            total += over * over
    norm = math.sqrt(total)
    if norm > 0.0:
        factor = np.float32(weight / norm)
        for n in range(len(rows)):
            i = rows[n]
            length = _length(xyz[i])
            if not unbound[i] and length > limit[face[i]]:
                for c in range(3):
                    gradient[i, c] += factor * (length - limit[face[i]]) * xyz[i, c] / length
    return norm


@part_jit
def _length(v):
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
