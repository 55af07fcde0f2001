"""Sorting of projected splats into tiles, front to back."""

import math

import numpy as np

from . import inline_jit, jit, kernel_jit, part_jit
from .elementary import prefetch
from .layout import MEAN_X, MEAN_Y, PRECISION_X, PRECISION_Y, SHEAR, TILE
from .threads import next_piece, parallel

RADIX_BITS = 11
SPLATS_PER_SORT = 8_192
"""Splats that a thread sorts at a time."""
SORT_PARTS = 16
"""Parallel parts: the splats, sorted near to far, are cut into as many of equal length."""


@jit
def list_visible(rect):
    """The splats (M,) int32 with tiles in their bounds, rect (N, 4)."""
    found, count = np.empty(len(rect), np.int32), 0
    for i in range(np.uint64(len(rect))):
        found[count] = i
        count += rect[i, 2] > rect[i, 0]
    return found[:count]


def depth_order(depth: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """The candidates (M,) int32 sorted by depth, near to far; equal depths keep their order.

    Least-significant-digit radix sort on the bits of the float: positive floats order like their bits. Counted from the
    least, the depths of a head have 22 bits, and take two of the three passes.
    """
    if len(candidates) == 0:
        return candidates
    keys, values = np.empty(len(candidates), np.uint32), candidates
    least, greatest = collect_keys(depth.view(np.uint32), candidates, keys)
    least = np.uint32(least)
    counts = np.empty((-(-len(keys) // SPLATS_PER_SORT), 1 << RADIX_BITS), np.int32)
    for shift in range(0, int(greatest - least).bit_length(), RADIX_BITS):
        digit, moved_keys, moved = np.uint32(shift), np.empty_like(keys), np.empty_like(values)
        count_digits(counts, keys, least, digit)
        sum_digits(counts)
        move_by_digit(counts, keys, values, least, digit, moved_keys, moved)
        keys, values = moved_keys, moved
    return values


@jit
def collect_keys(bits, candidates, keys):
    """Write the bits (N,) uint32 of the candidates (M,) to keys (M,); returns the least and the greatest, uint32."""
    least = greatest = bits[np.uint64(candidates[0])]
    for n in range(np.uint64(len(candidates))):
        key = bits[np.uint64(candidates[n])]
        keys[n] = key
        least, greatest = min(least, key), max(greatest, key)
    return least, greatest


@inline_jit
def _digit(key, least, shift):
    return np.uint64((np.uint32(key - least) >> shift) & np.uint32((1 << RADIX_BITS) - 1))


@parallel(lambda counts, *_: len(counts), piece=16)
@kernel_jit
def count_digits(work, counts, keys, least, shift):
    """Count in each part of the keys (M,) uint32, SPLATS_PER_SORT long, how often each digit occurs.

    The digit is that of the key minus `least`, from bit `shift` on, both uint32. counts (parts, digits) int32.
    """
    part, past_part = next_piece(work)
    while part < past_part:
        for k in range(part, past_part):
            row = counts[k]
            row[:] = 0
            for n in range(np.uint64(k * SPLATS_PER_SORT), np.uint64(min(len(keys), (k + 1) * SPLATS_PER_SORT))):
                row[_digit(keys[n], least, shift)] += 1
        part, past_part = next_piece(work)


@jit
def sum_digits(counts):
    """Turn the counts of `count_digits` into the place of each part's first key of each digit."""
    found = 0
    for digit in range(counts.shape[1]):
        for k in range(counts.shape[0]):
            count = counts[k, digit]
            counts[k, digit] = found
            found += count


@parallel(lambda counts, *_: len(counts))
@kernel_jit
def move_by_digit(work, place, keys, values, least, shift, moved_keys, moved):
    """Write keys and values (M,) sorted by a digit; `place` holds the places of `sum_digits` and is advanced."""
    part, past_part = next_piece(work)
    while part < past_part:
        for k in range(part, past_part):
            row = place[k]
            for n in range(np.uint64(k * SPLATS_PER_SORT), np.uint64(min(len(keys), (k + 1) * SPLATS_PER_SORT))):
                digit = _digit(keys[n], least, shift)
                at = np.uint64(row[digit])
                moved_keys[at], moved[at] = keys[n], values[n]
                row[digit] += 1
        part, past_part = next_piece(work)


SPLATS_AHEAD = 16
"""So many splats ahead, memory is asked for what lies in no order."""


@part_jit
def _prefetch_rect(rect, order, n, past):
    """Ask memory for the bounds of the splat SPLATS_AHEAD after the n-th in order: they lie anywhere."""
    prefetch(rect, np.uint64(order[min(n + np.uint64(SPLATS_AHEAD), past - np.uint64(1))]) * np.uint64(4))


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
@kernel_jit
def count_pairs(work, rect, order, tiles_x, counts, pairs):
    """Count the (splat, tile) pairs of each part of order (M,) int32: the splats, near to far.

    rect (N, 4) int32 tile bounds. Writes counts (SORT_PARTS, tiles) int32 and pairs (N,) int32, of the splats in
    `order`.
    """
    part, past_part = next_piece(work)
    while part < past_part:
        for k in range(part, past_part):
            row = counts[k]
            row[:] = 0
            past = np.uint64((k + 1) * len(order) // SORT_PARTS)
            for n in range(np.uint64(k * len(order) // SORT_PARTS), past):
                _prefetch_rect(rect, order, n, past)
                i = np.uint64(order[n])
                tile, width, total = _tiles_of(rect, i, tiles_x)
                pairs[i] = total
                column = np.uint64(1)
                for _ in range(total):
                    row[tile] += 1
                    tile, column = _next_tile(tile, column, width, tiles_x)
        part, past_part = next_piece(work)


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
@kernel_jit
def fill_pairs(work, rect, order, tiles_x, place, first_pair, splat_pairs, pair_splat):
    """Write every tile's pairs front to back; `place` holds the offsets of `compute_offsets` and is advanced.

    pair_splat (P,) int32: whose pair it is. splat_pairs (P,) int32: where the pairs of a splat stand, its first at
    first_pair[i].
    """
    part, past_part = next_piece(work)
    while part < past_part:
        for k in range(part, past_part):
            row = place[k]
            past = np.uint64((k + 1) * len(order) // SORT_PARTS)
            for n in range(np.uint64(k * len(order) // SORT_PARTS), past):
                _prefetch_rect(rect, order, n, past)
                i = np.uint64(order[n])
                tile, width, total = _tiles_of(rect, i, tiles_x)
                first, column = np.uint64(first_pair[i]), np.uint64(1)
                for found in range(first, first + total):
                    at = row[tile]
                    row[tile] = at + 1
                    pair_splat[np.uint64(at)] = i
                    splat_pairs[found] = at
                    tile, column = _next_tile(tile, column, width, tiles_x)
        part, past_part = next_piece(work)


def whole_tiles(count: int) -> np.ndarray:
    """`find_needed_rows` of an image of `count` tiles that is needed everywhere."""
    return np.tile(np.array([0, TILE, 0, TILE], np.uint8), (count, 1))


@part_jit
def _cell(pixel, size, cells):
    """The cell of `size` pixels that a coordinate, float32, lies in, of so many cells."""
    return np.int64(min(np.float32(cells), max(np.float32(0.0), np.floor(pixel / size))))


@part_jit
def _add_box(count, x0, y0, x1, y1):
    """Count one more from (x0, y0) to before (x1, y1), as differences between neighbors: four whatever the size."""
    count[y0, x0] += 1
    count[y0, x1] -= 1
    count[y1, x0] -= 1
    count[y1, x1] += 1


@part_jit
def _sum_boxes(count):
    """Turn the differences of `_add_box` into counts."""
    for y in range(count.shape[0]):
        along = 0
        for x in range(count.shape[1]):
            along += count[y, x]
            count[y, x] = along + (count[y - 1, x] if y > 0 else 0)


@jit
def find_needed_rows(projection, splats, reach, tiles_x, tiles_y):
    """The tiles that the listed splats (M,) reach, and the rows of tiles in which a pixel may be at most `reach`
    pixels, float32, away from one that they reach.

    Returns touched (tiles_y, tiles_x) bool, the tiles that they reach, which are needed whole, and tile_rows (tiles, 4)
    uint8: first and past-the-last row in the left and in the right half of each tile, both even; the first is not
    before the other where there are none.
    """
    projected, extent_y, rect = projection.columns, projection.extent_y, projection.rect
    two, half, slack = np.float32(2.0), np.float32(TILE // 2), np.float32(1e-4)
    strips, pairs = 2 * tiles_x, TILE // 2 * tiles_y  # cells: two rows of half a tile
    near, reached = np.zeros((pairs + 1, strips + 1), np.int32), np.zeros((tiles_y + 1, tiles_x + 1), np.int32)
    for n in range(len(splats)):
        i = np.uint64(splats[n])
        if rect[i, 2] <= rect[i, 0]:
            continue
        _add_box(reached, rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3])
        x, y, ey, shear = projected[i, MEAN_X], projected[i, MEAN_Y], extent_y[i], projected[i, SHEAR]
        ex = ey * math.sqrt(projected[i, PRECISION_Y] / projected[i, PRECISION_X] + shear * shear)
        ex, ey = ex + slack * ex + reach + np.float32(0.5), ey + slack * ey + reach + np.float32(0.5)
        _add_box(
            near, _cell(x - ex, half, strips), _cell(y - ey, two, pairs), _cell(x + ex + half, half, strips),
            _cell(y + ey + two, two, pairs),
        )  # fmt: skip
    _sum_boxes(reached)
    _sum_boxes(near)
    touched, tile_rows = np.empty((tiles_y, tiles_x), np.bool_), np.empty((tiles_y * tiles_x, 4), np.uint8)
    for tile in range(tiles_y * tiles_x):
        ty, tx = tile // tiles_x, tile % tiles_x
        touched[ty, tx] = reached[ty, tx] > 0
        for side in range(2):
            first, past = TILE // 2, 0
            for pair in range(TILE // 2):
                if touched[ty, tx] or near[ty * (TILE // 2) + pair, 2 * tx + side] > 0:
                    first, past = min(first, pair), pair + 1
            tile_rows[tile, 2 * side], tile_rows[tile, 2 * side + 1] = 2 * first, 2 * past
    return touched, tile_rows
