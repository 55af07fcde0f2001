"""Per-row work of training: Adam on listed rows only, and the scale limit."""

import math

import numpy as np
from numba import prange

from . import jit, parallel_jit

ZERO, ONE = np.float32(0.0), np.float32(1.0)
CHUNK = 256


@parallel_jit
def count_steps(rows, steps, correct1, correct2, beta1, beta2):
    """Count a step of each listed row (M,) in steps (N,) int32 and write its two bias corrections (M,)."""
    log1, log2 = math.log(beta1), math.log(beta2)
    for n in prange(len(rows)):
        steps[rows[n]] += 1
        count = np.float64(steps[rows[n]])
        correct1[n] = 1.0 / (1.0 - math.exp(count * log1))
        correct2[n] = 1.0 / math.sqrt(1.0 - math.exp(count * log2))


@parallel_jit
def adam_rows(rows, parameter, gradient, first, second, correct1, correct2, rates, beta1, beta2, epsilon):
    """One Adam step on the listed rows (M,) of parameter (N, D), with each row's own bias corrections (M,).

    rates (D,): learning rate by column. Rows that are not listed are not touched: neither parameter nor moments.
    A row whose gradient is not finite keeps its values.
    """
    width = parameter.shape[1]
    for block in prange((len(rows) + CHUNK - 1) // CHUNK):
        for n in range(block * CHUNK, min(len(rows), (block + 1) * CHUNK)):
            i = rows[n]
            unsound = ZERO
            for c in range(width):
                unsound += gradient[i, c] * ZERO
            if unsound != ZERO:
                continue
            scale1, scale2 = correct1[n], correct2[n]
            for c in range(width):
                g = gradient[i, c]
                m = beta1 * first[i, c] + (ONE - beta1) * g
                v = beta2 * second[i, c] + (ONE - beta2) * g * g
                first[i, c] = m
                second[i, c] = v
                parameter[i, c] -= rates[c] * m * scale1 / (math.sqrt(v) * scale2 + epsilon)


@jit
def scale_limit(rows, log_scale, face, loose, limit, weight, gradient):
    """weight · ‖ReLU(scale − limit)‖₂ over the listed rows; its gradient is added to gradient (N, 3).

    limit (F,) per triangle, in the unit of the splats' local scale. Loose splats have no limit. Returns the norm.
    """
    total = 0.0
    for n in range(len(rows)):
        i = rows[n]
        if not loose[i]:
            for c in range(3):
                over = max(ZERO, math.exp(log_scale[i, c]) - limit[face[i]])
                total += over * over
    norm = math.sqrt(total)
    if norm > 0.0:
        factor = np.float32(weight / norm)
        for n in range(len(rows)):
            i = rows[n]
            if not loose[i]:
                for c in range(3):
                    scale = math.exp(log_scale[i, c])
                    gradient[i, c] += factor * max(ZERO, scale - limit[face[i]]) * scale
    return norm


@jit
def distance_limit(rows, xyz, face, loose, limit, weight, gradient):
    """weight · ‖ReLU(|xyz| − limit)‖₂ over the listed rows; its gradient is added to gradient (N, 3).

    limit (F,) per triangle in local units. Loose splats have no limit. Returns the norm.
    """
    total = 0.0
    for n in range(len(rows)):
        i = rows[n]
        if not loose[i]:
            over = max(ZERO, _length(xyz[i]) - limit[face[i]])
            total += over * over
    norm = math.sqrt(total)
    if norm > 0.0:
        factor = np.float32(weight / norm)
        for n in range(len(rows)):
            i = rows[n]
            length = _length(xyz[i])
            if not loose[i] and length > limit[face[i]]:
                for c in range(3):
                    gradient[i, c] += factor * (length - limit[face[i]]) * xyz[i, c] / length
    return norm


@jit
def fade(rows, opacity, loose, weight, gradient):
    """Add `weight` to the opacity gradient (N,) of the listed loose splats.

    Adam turns even a tiny steady gradient into full steps, so a splat that no image holds against it (hidden behind
    the head in every view, say) fades away, and one that any image needs does not notice.
    """
    for n in range(len(rows)):
        if loose[rows[n]]:
            o = ONE / (ONE + math.exp(-opacity[rows[n]]))
            gradient[rows[n]] += weight * o * (ONE - o)


@jit
def _length(v):
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
