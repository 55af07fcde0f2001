"""Which rows of pixels a splat's outline, the ellipse on which α = 1/255, reaches between two
columns."""

import math

import numpy as np

from . import part_jit

ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@part_jit
def outline(mean_x, mean_y, precision_x, shear, precision_y, extent_y):
    """Coefficients of a projected splat's outline for `rows_within`; the arguments are its columns
    (see `layout.py`).

    On its outline the squares that make the exponent add up to precision_y·extent_y².
    """
    shrink = ONE / (precision_x * shear * shear + precision_y)
    chord = precision_y * extent_y * extent_y * shrink
    # Slack, so that rounding (of differences of squares above all) does not lose a pixel.
    slack = np.float32(0.01) + np.float32(1e-3) * math.sqrt(chord) + np.float32(1e-6) * extent_y
    lean, rate = shear * extent_y, precision_x * shear * shrink
    cut = precision_x * precision_y * shrink * shrink
    return mean_x - HALF, mean_y - HALF, extent_y, lean, rate, chord, cut, slack


@part_jit
def rows_within(outline, left, width, rows):
    """First and past-the-last of rows 0 to `rows` in which a pixel of the `width` columns from
    `left` on has its center in an outline; the first is not before the other where there are none.
    All float32.

    Between the outermost centers the ellipse is highest where it is highest altogether, or else at
    the nearer edge, and likewise lowest.
    """
    mean_x, mean_y, extent_y, lean, rate, chord, cut, slack = outline
    low = left - mean_x
    high = low + width - ONE
    nearest = min(max(ZERO, low), high)
    top, bottom = min(max(-lean, low), high), min(max(lean, low), high)
    up = rate * top - math.sqrt(max(ZERO, chord - cut * top * top)) - slack
    down = rate * bottom + math.sqrt(max(ZERO, chord - cut * bottom * bottom)) + slack
    first = np.ceil(max(ZERO, mean_y + max(up, -extent_y)))
    past = np.floor(min(rows - ONE, mean_y + min(down, extent_y))) + ONE
    reached = cut * nearest * nearest <= np.float32(1.00001) * chord
    return min(first, rows) if reached else rows, max(past, ZERO) if reached else ZERO
