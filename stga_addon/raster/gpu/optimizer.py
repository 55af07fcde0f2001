"""Optimizer kernels, the counterpart of `cpu/optimizer.py`; the rows to step are marked in `wanted`."""

import warp as wp

from ..cpu import optimizer as cpu
from .tiles import UNMARKED

wp.set_module_options({"enable_backward": False})

MAX_GRADIENT = wp.constant(float(cpu.MAX_GRADIENT))


@wp.kernel
def mark_focus(face: wp.array[wp.int32], selected: wp.array[wp.uint8], focus: wp.array[wp.uint8]):
    """focus (N,): whether the splat's triangle is selected (F,)."""
    i = wp.tid()
    focus[i] = selected[face[i]]


@wp.kernel
def count_steps(
    wanted: wp.array[wp.uint8],
    log_beta1: wp.float64,
    log_beta2: wp.float64,
    newest: wp.float32,
    steps: wp.array[wp.int32],
    correct: wp.array[wp.vec3],
):
    """Add a step to the wanted rows, and write what corrects their first and second moment's bias and how much the
    step counts in their running average: `newest`, or more in the beginning.

    In float64, because 1 − βⁿ cancels.
    """
    i = wp.tid()
    if wanted[i] == UNMARKED:
        return
    steps[i] = steps[i] + 1
    n, one = wp.float64(steps[i]), wp.float64(1.0)
    first, second = one / (one - wp.exp(n * log_beta1)), one / wp.sqrt(one - wp.exp(n * log_beta2))
    correct[i] = wp.vec3(float(first), float(second), wp.max(newest, float(wp.float64(4.0) / (n + wp.float64(3.0)))))


@wp.kernel
def adam(
    wanted: wp.array[wp.uint8],
    correct: wp.array[wp.vec3],
    parameter: wp.array2d[wp.float32],
    gradient: wp.array2d[wp.float32],
    first: wp.array2d[wp.float32],
    second: wp.array2d[wp.float32],
    average: wp.array2d[wp.float32],
    rate: wp.float32,
    rate_rest: wp.float32,
    rest: wp.int32,
    beta1: wp.float32,
    beta2: wp.float32,
    epsilon: wp.float32,
):
    """One step of a parameter's (N, D) wanted rows, a thread a value; `rate_rest` is for the columns from `rest` on.

    A row whose gradient is not finite, or beyond MAX_GRADIENT, keeps its value and moments.
    """
    i, c = wp.tid()
    if wanted[i] == UNMARKED:
        return
    for other in range(gradient.shape[1]):
        if not (wp.abs(gradient[i, other]) < MAX_GRADIENT):
            return
    g = gradient[i, c]
    m = beta1 * first[i, c] + (1.0 - beta1) * g
    v = beta2 * second[i, c] + (1.0 - beta2) * g * g
    first[i, c] = m
    second[i, c] = v
    step = wp.where(c < rest, rate, rate_rest) * m * correct[i][0] / (wp.sqrt(v) * correct[i][1] + epsilon)
    value = parameter[i, c] - step
    parameter[i, c] = value
    average[i, c] = average[i, c] + correct[i][2] * (value - average[i, c])


@wp.func
def _over(value: float, limit: float) -> float:
    return wp.max(0.0, value - limit)


@wp.kernel
def scale_excess(
    wanted: wp.array[wp.uint8],
    unbound: wp.array[wp.uint8],
    log_scale: wp.array[wp.vec3],
    face: wp.array[wp.int32],
    limits: wp.array2d[wp.float32],
    squares: wp.array[wp.float32],
):
    """‖ReLU(scale − limit)‖² of each row, 0 for rows that are not wanted; limits (2, F) of bound and unbound splats."""
    i = wp.tid()
    total = float(0.0)
    if wanted[i] != UNMARKED:
        for c in range(3):
            over = _over(wp.exp(log_scale[i][c]), limits[int(unbound[i]), face[i]])
            total += over * over
    squares[i] = total


@wp.kernel
def scale_limit(
    wanted: wp.array[wp.uint8],
    unbound: wp.array[wp.uint8],
    log_scale: wp.array[wp.vec3],
    face: wp.array[wp.int32],
    limits: wp.array2d[wp.float32],
    weight: wp.float32,
    square: wp.array[wp.float32],
    gradient: wp.array[wp.vec3],
):
    """Add the gradient of weight · ‖ReLU(scale − limit)‖₂, whose square is given."""
    i = wp.tid()
    if wanted[i] == UNMARKED or not (square[0] > 0.0):
        return
    factor = weight / wp.sqrt(square[0])
    v_log_scale = wp.vec3()
    for c in range(3):
        scale = wp.exp(log_scale[i][c])
        v_log_scale[c] = factor * _over(scale, limits[int(unbound[i]), face[i]]) * scale
    gradient[i] = gradient[i] + v_log_scale


@wp.kernel
def opacity_weight(
    wanted: wp.array[wp.uint8],
    opacity: wp.array[wp.float32],
    share: wp.array[wp.float32],
    weight: wp.float32,
    gradient: wp.array[wp.float32],
):
    """Add the gradient of weight · Σ share · sigmoid(opacity)."""
    i = wp.tid()
    if wanted[i] == UNMARKED:
        return
    value = 1.0 / (1.0 + wp.exp(-opacity[i]))
    gradient[i] = gradient[i] + weight * share[i] * value * (1.0 - value)


@wp.kernel
def distance_excess(
    wanted: wp.array[wp.uint8],
    unbound: wp.array[wp.uint8],
    xyz: wp.array[wp.vec3],
    face: wp.array[wp.int32],
    limit: wp.array[wp.float32],
    squares: wp.array[wp.float32],
):
    """ReLU(|xyz| − limit)² of each row, 0 for rows that are not wanted or unbound."""
    i = wp.tid()
    over = float(0.0)
    if wanted[i] != UNMARKED and unbound[i] == UNMARKED:
        over = _over(wp.length(xyz[i]), limit[face[i]])
    squares[i] = over * over


@wp.kernel
def distance_limit(
    wanted: wp.array[wp.uint8],
    unbound: wp.array[wp.uint8],
    xyz: wp.array[wp.vec3],
    face: wp.array[wp.int32],
    limit: wp.array[wp.float32],
    weight: wp.float32,
    square: wp.array[wp.float32],
    gradient: wp.array[wp.vec3],
):
    """Add the gradient of weight · ‖ReLU(|xyz| − limit)‖₂, whose square is given."""
    i = wp.tid()
    if wanted[i] == UNMARKED or unbound[i] != UNMARKED or not (square[0] > 0.0):
        return
    length = wp.length(xyz[i])
    over = _over(length, limit[face[i]])
    if over > 0.0:
        gradient[i] = gradient[i] + (weight / wp.sqrt(square[0]) * over / length) * xyz[i]


@wp.kernel
def accumulate_screen_gradient(
    wanted: wp.array[wp.uint8],
    screen: wp.array[wp.float32],
    screen_gradient: wp.array[wp.float32],
    gradient_count: wp.array[wp.float32],
):
    """What density control asks for: the sum of screen-space gradients, and how many."""
    i = wp.tid()
    if wanted[i] == UNMARKED:
        return
    screen_gradient[i] = screen_gradient[i] + screen[i]
    gradient_count[i] = gradient_count[i] + 1.0
