"""Sorting of projected splats into tiles, front to back."""

import numpy as np

from . import inline_jit, jit
from .threads import parallel

RADIX_BITS = 11
SORT_PARTS = 16
"""Parallel parts: the splats, sorted near to far, are cut into as many of equal length."""


@jit
def list_visible(rect):
    """The splats (M,) int32 with tiles in their bounds, rect (N, 4)."""
    found, count = np.empty(len(rect), np.int32), 0
    for i in range(np.uint64(len(rect))):
        found[count] = i
        count += rect[i, 2] > rect[i, 0]
    return found[:count].copy()


@jit
def depth_order(depth, candidates):
    """The candidates (M,) int32 sorted by depth, near to far; equal depths keep their order.

    Least-significant-digit radix sort on the bits of the float: positive floats order like their bits. Counted from the
    least, the depths of a head have 22 bits, and take two of the three passes.
    """
    buckets, count = 1 << RADIX_BITS, np.uint64(len(candidates))
    bits, mask = depth.view(np.uint32), np.uint32(buckets - 1)
    keys, values = np.empty(len(candidates), np.uint32), candidates.copy()
    least, most = np.uint32(0xFFFFFFFF), np.uint32(0)
    for n in range(count):
        key = bits[np.uint64(candidates[n])]
        keys[n], least, most = key, min(least, key), max(most, key)
    next_keys, next_values = np.empty_like(keys), np.empty_like(values)
    shift = np.uint32(0)
    while most > least and np.uint32(most - least) >> shift > 0:
        place = np.zeros(buckets + 1, np.int64)
        for n in range(count):
            place[np.uint64((np.uint32(keys[n] - least) >> shift) & mask) + np.uint64(1)] += 1
        for b in range(buckets):
            place[b + 1] += place[b]
        for n in range(count):
            digit = np.uint64((np.uint32(keys[n] - least) >> shift) & mask)
            at = np.uint64(place[digit])
            next_keys[at], next_values[at] = keys[n], values[n]
            place[digit] += 1
        keys, next_keys = next_keys, keys
        values, next_values = next_values, values
        shift = np.uint32(shift + np.uint32(RADIX_BITS))
        if shift > np.uint32(2 * RADIX_BITS):
            break
    return values


@inline_jit
def _tiles_of(rect, i, tiles_x):
    """The first tile of splat i, how many it has in a row of tiles, and how many in all."""
    width, height = np.uint64(rect[i, 2] - rect[i, 0]), np.uint64(rect[i, 3] - rect[i, 1])
    return np.uint64(rect[i, 1] * tiles_x + rect[i, 0]), width, width * height


@inline_jit
def _next_tile(tile, column, width, tiles_x):
    """The splat's tile after `tile`, its column-th in the row, and its column. One loop over all of them, without a
    branch at the end of a row, is a fourth faster than two: the processor cannot foresee where short loops end."""
    is_last, one = column == width, np.uint64(1)
    step = np.uint64(tiles_x) - width + one if is_last else one
    return tile + step, one if is_last else column + one


@parallel(lambda *_: SORT_PARTS)
@jit
def count_pairs(part, past_part, rect, order, tiles_x, counts, pairs):
    """Count the (splat, tile) pairs of each part of order (M,) int32: the splats, near to far.

    rect (N, 4) int32 tile bounds. Writes counts (SORT_PARTS, tiles) int32 and pairs (N,) int32, of the splats in
    `order`.
    """
    for k in range(part, past_part):
        row = counts[k]
        row[:] = 0
        for n in range(np.uint64(k * len(order) // SORT_PARTS), np.uint64((k + 1) * len(order) // SORT_PARTS)):
            i = np.uint64(order[n])
            tile, width, total = _tiles_of(rect, i, tiles_x)
            pairs[i] = total
            column = np.uint64(1)
            for _ in range(total):
                row[tile] += 1
                tile, column = _next_tile(tile, column, width, tiles_x)


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
        row = place[k]
        for n in range(np.uint64(k * len(order) // SORT_PARTS), np.uint64((k + 1) * len(order) // SORT_PARTS)):
            i = np.uint64(order[n])
            tile, width, total = _tiles_of(rect, i, tiles_x)
            first, column = np.uint64(first_pair[i]), np.uint64(1)
            for found in range(first, first + total):
                at = row[tile]
                row[tile] = at + 1
                pair_splat[np.uint64(at)] = i
                splat_pairs[found] = at
                tile, column = _next_tile(tile, column, width, tiles_x)


@jit
def mark_tiles(rect, splats, marked):
    """Set marked (tiles_y, tiles_x) bool where one of the splats (M,) reaches; rect (N, 4)."""
    for i in splats:
        for y in range(rect[i, 1], rect[i, 3]):
            for x in range(rect[i, 0], rect[i, 2]):
                marked[y, x] = True
