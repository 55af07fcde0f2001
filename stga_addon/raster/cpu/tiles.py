"""Sorting of projected splats into tiles, front to back."""

import numpy as np

from . import jit
from .threads import parallel

RADIX_BITS = 11
SORT_PARTS = 16
"""Parallel parts: the splats, sorted near to far, are cut into as many of equal length."""


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


@parallel(lambda *_: SORT_PARTS)
@jit
def count_pairs(part, past_part, rect, order, tiles_x, counts, pairs):
    """Count the (splat, tile) pairs of each part of order (M,) int32: the splats, near to far.

    rect (N, 4) int32 tile bounds. Writes counts (SORT_PARTS, tiles) int32 and pairs (N,) int32, of the splats in
    `order`.
    """
    for k in range(part, past_part):
        counts[k, :] = 0
        for n in range(k * len(order) // SORT_PARTS, (k + 1) * len(order) // SORT_PARTS):
            i = order[n]
            x0, y0, x1, y1 = rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3]
            pairs[i] = (x1 - x0) * (y1 - y0)
            for y in range(y0, y1):
                for x in range(x0, x1):
                    counts[k, y * tiles_x + x] += 1


@jit
def compute_offsets(visible, pairs, counts, first_pair):
    """Turn the counts of `count_pairs` into the offset of each part's pairs in each tile's list.

    visible (M,) int32. Writes first_pair (N,): where each of these splats' pairs begin in `splat_pairs`.
    Returns start (tiles + 1,) int64: where each tile's list begins.
    """
    found = 0
    for n in range(len(visible)):
        first_pair[visible[n]] = found
        found += pairs[visible[n]]
    start = np.zeros(counts.shape[1] + 1, np.int64)
    for tile in range(counts.shape[1]):
        place = start[tile]
        for k in range(SORT_PARTS):
            count = counts[k, tile]
            counts[k, tile] = place
            place += count
        start[tile + 1] = place
    return start


@parallel(lambda *_: SORT_PARTS)
@jit
def fill_pairs(part, past_part, rect, order, tiles_x, place, first_pair, splat_pairs, pair_splat):
    """Write every tile's pairs front to back; `place` holds the offsets of `compute_offsets` and is advanced.

    pair_splat (P,) int32: whose pair it is. splat_pairs (P,) int32: where the pairs of a splat stand, its first at
    first_pair[i].
    """
    for k in range(part, past_part):
        for n in range(k * len(order) // SORT_PARTS, (k + 1) * len(order) // SORT_PARTS):
            i = order[n]
            x0, y0, x1, y1 = rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3]
            found = first_pair[i]
            for y in range(y0, y1):
                for x in range(x0, x1):
                    at = place[k, y * tiles_x + x]
                    place[k, y * tiles_x + x] = at + 1
                    pair_splat[at] = i
                    splat_pairs[found] = at
                    found += 1


@jit
def mark_tiles(rect, splats, marked):
    """Set marked (tiles_y, tiles_x) bool where one of the splats (M,) reaches; rect (N, 4)."""
    for i in splats:
        for y in range(rect[i, 1], rect[i, 3]):
            for x in range(rect[i, 0], rect[i, 2]):
                marked[y, x] = True
