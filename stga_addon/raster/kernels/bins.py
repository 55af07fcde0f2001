"""Which splats touch which tile, front to back."""

import math

import numpy as np

from . import jit, part_jit
from .blend import MEAN_X, MEAN_Y, PRECISION_X, PRECISION_Y, SHEAR, TILE
from .threads import parallel

ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
RADIX_BITS = 11
PARTS = 16
"""Equal parts of the splats, near to far, whose pairs are counted and listed side by side."""


@jit
def depth_order(depth, candidates):
    """The candidates (M,) int32 sorted by depth, near to far; equal depths keep their order.

    Least-significant-digit radix sort on the bits of the float: positive floats order like their bits.
    """
    buckets = 1 << RADIX_BITS
    bits = depth.view(np.uint32)
    keys, values = np.empty(len(candidates), np.uint32), candidates.copy()
    for n in range(len(candidates)):
        keys[n] = bits[candidates[n]]
    next_keys, next_values = np.empty_like(keys), np.empty_like(values)
    for shift in (np.uint32(0), np.uint32(RADIX_BITS), np.uint32(2 * RADIX_BITS)):
        place = np.zeros(buckets + 1, np.int64)
        for n in range(len(keys)):
            place[((keys[n] >> shift) & np.uint32(buckets - 1)) + 1] += 1
        for b in range(buckets):
            place[b + 1] += place[b]
        for n in range(len(keys)):
            digit = (keys[n] >> shift) & np.uint32(buckets - 1)
            next_keys[place[digit]] = keys[n]
            next_values[place[digit]] = values[n]
            place[digit] += 1
        keys, next_keys = next_keys, keys
        values, next_values = next_values, values
    return values


@part_jit
def _ellipse(projected, extent_y, i):
    """What `_rows` wants to know of splat i's outline, on which α = 1/255.

    On it the squares that make the exponent (see `blend.py`) add up to PRECISION_Y·extent_y².
    """
    precision_x, shear, precision_y = projected[i, PRECISION_X], projected[i, SHEAR], projected[i, PRECISION_Y]
    reach = extent_y[i]
    shrink = ONE / (precision_x * shear * shear + precision_y)
    chord = precision_y * reach * reach * shrink
    # Rounding, of differences of squares above all, must not cost a pixel.
    slack = np.float32(0.01) + np.float32(1e-3) * math.sqrt(chord) + np.float32(1e-6) * reach
    return (
        projected[i, MEAN_X] - HALF, projected[i, MEAN_Y] - HALF, reach, shear * reach, precision_x * shear * shrink,
        chord, precision_x * precision_y * shrink * shrink, slack,
    )  # fmt: skip


@part_jit
def _rows(ellipse, column, above, below):
    """First and past-the-last row of pixels, of those from `above` to before `below`, that a column of tiles shares
    with an ellipse; the first is not before the other where there are none.

    Between the column's outermost pixel centres the ellipse is highest where it is highest altogether, or else at the
    nearer edge, and likewise lowest.
    """
    mean_x, mean_y, reach, lean, rate, chord, cut, slack = ellipse
    low = np.float32(column * TILE) - mean_x
    high = low + np.float32(TILE - 1)
    nearest = min(max(ZERO, low), high)
    if cut * nearest * nearest > np.float32(1.00001) * chord:
        return np.int64(0), np.int64(0)
    top, bottom = min(max(-lean, low), high), min(max(lean, low), high)
    up = rate * top - math.sqrt(max(ZERO, chord - cut * top * top)) - slack
    down = rate * bottom + math.sqrt(max(ZERO, chord - cut * bottom * bottom)) + slack
    first = np.ceil(max(np.float32(above), mean_y + max(up, -reach)))
    past = np.floor(min(np.float32(below - 1), mean_y + min(down, reach))) + ONE
    return np.int64(min(first, np.float32(below))), np.int64(max(past, np.float32(above)))


@parallel(lambda *_: PARTS)
@jit
def count_pairs(part, past_part, projected, extent_y, rect, order, tiles_x, counts, pairs):
    """Count the (splat, tile) pairs of each part of order (M,) int32: the splats, near to far.

    projected (N, 9), extent_y (N,) and rect (N, 4) as from `project_forward`. Writes counts (PARTS, tiles) int32 and pairs
    (N,) int32, of the splats in `order`.
    """
    for k in range(part, past_part):
        counts[k, :] = 0
        for n in range(k * len(order) // PARTS, (k + 1) * len(order) // PARTS):
            i = order[n]
            count = 0
            above, below = rect[i, 1] * TILE, rect[i, 3] * TILE
            ellipse = _ellipse(projected, extent_y, i)
            for x in range(rect[i, 0], rect[i, 2]):
                first, past = _rows(ellipse, x, above, below)
                if first < past:
                    for y in range(first // TILE, (past - 1) // TILE + 1):
                        counts[k, y * tiles_x + x] += 1
                        count += 1
            pairs[i] = count


@jit
def lay_out(visible, pairs, counts, slot_start):
    """Turn the counts of `count_pairs` into the places where each part's pairs begin.

    visible (M,) int32: the splats in the order in which their pairs' gradients are to lie: splat i's from slot_start[i]
    on. Returns start (tiles + 1,) int64: where each tile's list begins.
    """
    slots = 0
    for n in range(len(visible)):
        slot_start[visible[n]] = slots
        slots += pairs[visible[n]]
    start = np.zeros(counts.shape[1] + 1, np.int64)
    for tile in range(counts.shape[1]):
        place = start[tile]
        for k in range(PARTS):
            count = counts[k, tile]
            counts[k, tile] = place
            place += count
        start[tile + 1] = place
    return start


@parallel(lambda *_: PARTS)
@jit
def fill_pairs(
    part, past_part, projected, extent_y, rect, order, tiles_x, place, slot_start, pair_splat, pair_slot, pair_rows
):
    """Write every tile's pairs front to back, from the places of `lay_out` on, which move along.

    pair_splat (P,) int32; pair_slot (P,) int32: where the pair's gradient belongs; pair_rows (P, 2) uint8: first and
    past-the-last of the tile's rows of pixels that the splat may reach.
    """
    for k in range(part, past_part):
        for n in range(k * len(order) // PARTS, (k + 1) * len(order) // PARTS):
            i = order[n]
            slot = slot_start[i]
            above, below = rect[i, 1] * TILE, rect[i, 3] * TILE
            ellipse = _ellipse(projected, extent_y, i)
            for x in range(rect[i, 0], rect[i, 2]):
                first, past = _rows(ellipse, x, above, below)
                if first < past:
                    for y in range(first // TILE, (past - 1) // TILE + 1):
                        at = place[k, y * tiles_x + x]
                        place[k, y * tiles_x + x] += 1
                        pair_splat[at], pair_slot[at] = i, slot
                        pair_rows[at, 0] = max(first - y * TILE, 0)
                        pair_rows[at, 1] = min(past - y * TILE, TILE)
                        slot += 1


@jit
def reaching(rect, visible, drawn):
    """The splats of visible (M,) int32 that reach a tile of drawn (tiles_y, tiles_x) bool, in their order."""
    kept = np.empty_like(visible)
    count = 0
    for n in range(len(visible)):
        i = visible[n]
        found = False
        for y in range(rect[i, 1], rect[i, 3]):
            for x in range(rect[i, 0], rect[i, 2]):
                found |= drawn[y, x]
        kept[count] = i
        count += found
    return kept[:count]


@jit
def mark_tiles(projected, extent_y, rect, focus, marked):
    """Set marked (tiles_y, tiles_x) bool where a splat of focus (N,) bool has a pair."""
    for i in range(len(rect)):
        if focus[i]:
            above, below = rect[i, 1] * TILE, rect[i, 3] * TILE
            ellipse = _ellipse(projected, extent_y, i)
            for x in range(rect[i, 0], rect[i, 2]):
                first, past = _rows(ellipse, x, above, below)
                if first < past:
                    for y in range(first // TILE, (past - 1) // TILE + 1):
                        marked[y, x] = True
