"""Which splats touch which tile, front to back."""

import numpy as np

from . import jit
from .threads import parallel

RADIX_BITS = 11


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


@jit
def count_pairs(rect, order, tiles_x, tiles_y, slot_start, slot_count):
    """Count each tile's splats and give every (splat, tile) pair a slot.

    rect (N, 4) int32 tile bounds. Writes slot_start and slot_count (N,) int32 for the splats in `order`, numbered in
    that order; returns start (tiles + 1,) int64: where each tile's list begins.
    """
    counts = np.zeros((tiles_y + 1) * (tiles_x + 1), np.int64)
    stride = tiles_x + 1
    slots = 0
    for n in range(len(order)):
        i = order[n]
        x0, y0, x1, y1 = rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3]
        slot_start[i] = slots
        slot_count[i] = (x1 - x0) * (y1 - y0)
        slots += slot_count[i]
        # Corners of the rectangle: two running sums turn them into counts.
        counts[y0 * stride + x0] += 1
        counts[y0 * stride + x1] -= 1
        counts[y1 * stride + x0] -= 1
        counts[y1 * stride + x1] += 1
    start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    for y in range(tiles_y):
        along = 0
        for x in range(tiles_x):
            along += counts[y * stride + x]
            counts[y * stride + x] = along + (counts[(y - 1) * stride + x] if y > 0 else 0)
            start[y * tiles_x + x + 1] = start[y * tiles_x + x] + counts[y * stride + x]
    return start


# One piece a thread, because each walks all splats.
@parallel(lambda rect, order, tiles_x, tiles_y, *_: tiles_y, pieces=1)
@jit
def fill_pairs(low, high, rect, order, tiles_x, tiles_y, slot_start, start, pair_splat, pair_slot):
    """Write every tile's splats front to back, for the rows of tiles [low, high)."""
    place = start[low * tiles_x : high * tiles_x].copy()
    for n in range(len(order)):
        i = order[n]
        x0, y0, x1, y1 = rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3]
        for y in range(max(low, y0), min(high, y1)):
            slot = slot_start[i] + (y - y0) * (x1 - x0)
            for x in range(x0, x1):
                at = (y - low) * tiles_x + x
                pair_splat[place[at]] = i
                pair_slot[place[at]] = slot
                place[at] += 1
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
def mark_tiles(rect, focus, marked):
    """Set marked (tiles_y, tiles_x) bool where a splat of focus (N,) bool reaches; rect (N, 4)."""
    for i in range(len(rect)):
        if focus[i]:
            for y in range(rect[i, 1], rect[i, 3]):
                for x in range(rect[i, 0], rect[i, 2]):
                    marked[y, x] = True
