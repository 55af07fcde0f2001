"""Sorting of projected splats into tiles, front to back."""

import math
from typing import NamedTuple

import numpy as np

from . import inline_jit, jit, part_jit
from .blend import BLOCKS, BLOCKS_ALONG, RUN_TILES, SIDE
from .elementary import prefetch
from .layout import MEAN_X, MEAN_Y, PRECISION_X, PRECISION_Y, SHEAR
from .threads import call_helpers, end_stages, parallel, stage

RADIX_BITS = 11
"""Bits of a digit of the radix sort."""
DIGITS = 1 << RADIX_BITS
"""Values of a digit."""
SPLATS_PER_SORT = 4_096
"""Splats that a thread lists or sorts at a time."""
SORT_PARTS = 16
"""Parallel parts of equal length into which the splats, sorted near to far, are cut."""
SPLATS, PAIRS, LEAST, GREATEST = range(4)
"""Columns of a part's row: splats with a tile, their pairs, least and greatest key."""
RUN_BUCKETS = 512
"""Classes of runs of tiles by their number of pairs."""


@inline_jit
def _digit(key, least, shift):
    return np.uint64((np.uint32(key - least) >> shift) & np.uint32(DIGITS - 1))


class Sorting(NamedTuple):
    """Where `list_pairs` works, for N splats: parts (parts_of(N), 4) int64, see SPLATS; found,
    order and moved (N,) int32, keys and moved_keys (N,) uint32; digits (parts, DIGITS) and counts
    (SORT_PARTS, tiles) int32; totals (6,) int64, see FOUND."""

    parts: np.ndarray
    found: np.ndarray
    keys: np.ndarray
    order: np.ndarray
    moved_keys: np.ndarray
    moved: np.ndarray
    digits: np.ndarray
    counts: np.ndarray
    totals: np.ndarray


FOUND, WRITTEN, LEAST_KEY, KEY_SPAN, RENDERED = range(5)
"""Entries of `totals`: splats with a tile; their pairs; the key from which others are counted,
whose lowest digit is 0, so that lowest digits stay as they are; the greatest key counted from
there; tiles to be rendered."""


def parts_of(splats: int) -> int:
    """How many parts of SPLATS_PER_SORT splats there are."""
    return -(-splats // SPLATS_PER_SORT)


@parallel(lambda projection, *_: max(1, parts_of(len(projection.rect))))
def list_pairs(work, projection, tiles_x, tile_blocks, lists, tiles, sorting):
    """Write `lists`, see `TileLists`, of splats that reach tiles, all parts together; tile_blocks
    (tiles,) as of `find_needed_blocks`; tiles (tiles,) int32: first the RENDERED ones with a needed
    block, in the order in which they are rendered.

    Least-significant-digit radix sort on the bits of the depth: positive floats order like their
    bits. Counted from the least, the depths of a head have 22 bits, and take two of the three
    passes. Equal depths keep their order. Where the pairs need more room than `lists` has, only
    `totals` is of use.
    """
    call_helpers(work)
    rect = projection.rect
    totals = sorting.totals
    keys = sorting.keys
    order = sorting.order
    moved_keys = sorting.moved_keys
    moved = sorting.moved
    parts = len(sorting.parts)
    for k in stage(work, 0, parts):
        _list_visible(k, projection, lists, sorting)
    for _ in stage(work, 1, 1):
        _sum_parts(sorting)
    for k in stage(work, 2, parts):
        _move_visible(k, lists, sorting)
    keys, moved_keys = moved_keys, keys
    splats = totals[FOUND]
    parts = (splats + SPLATS_PER_SORT - 1) // SPLATS_PER_SORT
    step = np.int64(3)
    shift = np.int64(RADIX_BITS)
    while totals[KEY_SPAN] >> shift != 0:
        least = np.uint32(totals[LEAST_KEY])
        for k in stage(work, step, parts):
            _count_digits(k, sorting.digits[k], keys[:splats], least, np.uint32(shift))
        for _ in stage(work, step + 1, 1):
            _sum_counts(sorting.digits[:parts])
        for k in stage(work, step + 2, parts):
            place = sorting.digits[k]
            values = order[:splats]
            _move_by_digit(k, place, keys, values, least, np.uint32(shift), moved_keys, moved)
        keys, moved_keys = moved_keys, keys
        order, moved = moved, order
        step += 3
        shift += RADIX_BITS
    fits = totals[WRITTEN] <= len(lists.pair_splat)
    if fits:
        for k in stage(work, step, SORT_PARTS):
            _count_pairs(k, rect, order[:splats], tiles_x, sorting.counts[k])
        for _ in stage(work, step + 1, 1):
            totals[RENDERED] = _arrange_tiles(sorting.counts, tile_blocks, lists.start, tiles)
        for k in stage(work, step + 2, SORT_PARTS):
            _fill_pairs(k, rect, order[:splats], tiles_x, sorting.counts[k], lists)
    end_stages(work)


@inline_jit
def _list_visible(k, projection, lists, sorting):
    """List the splats of a part with tiles in their bounds, and their keys, from the part's first
    place on; `pairs`, and in `first_pair` how many pairs of the part come before."""
    rect = projection.rect
    depth_bits = projection.depth.view(np.uint32)
    found = sorting.found
    keys = sorting.keys
    pairs = lists.pairs
    first_pair = lists.first_pair
    parts = sorting.parts
    row = sorting.digits[k]
    count = np.uint64(0)
    before = np.int32(0)
    row[:] = 0
    begin = np.uint64(k * SPLATS_PER_SORT)
    least = np.uint32(0xFFFFFFFF)
    greatest = np.uint32(0)
    # Without a branch: the processor could not foresee which splats a local iteration sees.
    for i in range(begin, np.uint64(min(len(rect), (k + 1) * SPLATS_PER_SORT))):
        width = rect[i, 2] - rect[i, 0]
        key = depth_bits[i]
        visible = width > 0
        found[begin + count] = i
        keys[begin + count] = key
        pairs[i] = width * (rect[i, 3] - rect[i, 1])
        first_pair[i] = before
        count = count + np.uint64(visible)
        before = np.int32(before + pairs[i])
        row[_digit(key, np.uint32(0), np.uint32(0))] += visible
        least = min(least, key if visible else least)
        greatest = max(greatest, key if visible else greatest)
    parts[k, SPLATS] = count
    parts[k, PAIRS] = before
    parts[k, LEAST] = least
    parts[k, GREATEST] = greatest


@inline_jit
def _sum_parts(sorting):
    """Turn the splats and pairs of parts into those of the parts before, their counts of digits
    into places, and write `totals`."""
    parts = sorting.parts
    totals = sorting.totals
    splats = 0
    pairs = 0
    least = 0xFFFFFFFF
    greatest = 0
    for k in range(len(parts)):
        count = parts[k, SPLATS]
        before = parts[k, PAIRS]
        parts[k, SPLATS] = splats
        parts[k, PAIRS] = pairs
        splats = splats + count
        pairs = pairs + before
        least = min(least, parts[k, LEAST])
        greatest = max(greatest, parts[k, GREATEST])
    _sum_counts(sorting.digits)
    least = least // DIGITS * DIGITS
    totals[FOUND] = splats
    totals[WRITTEN] = pairs
    totals[LEAST_KEY] = least
    totals[KEY_SPAN] = max(0, greatest - least)


@part_jit
def _sum_counts(counts):
    """Turn counts (parts, columns) int32 into places: column by column, in each one part after the
    other.

    Returns where each column begins, and the sum (columns + 1,) int64. Row by row, in loops that
    vectorize.
    """
    start = np.zeros(counts.shape[1] + 1, np.int64)
    for k in range(counts.shape[0]):
        for c in range(counts.shape[1]):
            start[c + 1] += counts[k, c]
    for c in range(counts.shape[1]):
        start[c + 1] += start[c]
    place = start[:-1].astype(np.int32)
    for k in range(counts.shape[0]):
        for c in range(counts.shape[1]):
            count = counts[k, c]
            counts[k, c] = place[c]
            place[c] += count
    return start


@inline_jit
def _move_visible(k, lists, sorting):
    """Write a part's splats to `visible`, and with their keys sorted by the lowest digit to
    `order` and `moved_keys`; `first_pair` counts the pairs of the parts before from now on."""
    parts = sorting.parts
    found = sorting.found
    keys = sorting.keys
    moved_keys = sorting.moved_keys
    order = sorting.order
    visible = lists.visible
    first_pair = lists.first_pair
    row = sorting.digits[k]
    begin = np.uint64(k * SPLATS_PER_SORT)
    first = np.uint64(parts[k, SPLATS])
    before = np.int32(parts[k, PAIRS])
    is_last = k + 1 == len(parts)
    past = sorting.totals[FOUND] if is_last else parts[k + 1, SPLATS]
    for n in range(np.uint64(past) - first):
        i = found[begin + n]
        key = keys[begin + n]
        visible[first + n] = i
        first_pair[np.uint64(i)] += before
        digit = _digit(key, np.uint32(0), np.uint32(0))
        at = np.uint64(row[digit])
        moved_keys[at] = key
        order[at] = i
        row[digit] += 1


@inline_jit
def _count_digits(k, row, keys, least, shift):
    """Count how often each digit occurs in part k of the keys (M,) uint32: that of the key minus
    `least`, from bit `shift` on, both uint32."""
    row[:] = 0
    past = min(len(keys), (k + 1) * SPLATS_PER_SORT)
    for n in range(np.uint64(k * SPLATS_PER_SORT), np.uint64(past)):
        row[_digit(keys[n], least, shift)] += 1


@inline_jit
def _move_by_digit(k, row, keys, values, least, shift, moved_keys, moved):
    """Write part k of keys and values (M,) sorted by a digit; `row` holds its places of
    `_sum_counts` and is advanced."""
    past = min(len(values), (k + 1) * SPLATS_PER_SORT)
    for n in range(np.uint64(k * SPLATS_PER_SORT), np.uint64(past)):
        digit = _digit(keys[n], least, shift)
        at = np.uint64(row[digit])
        moved_keys[at] = keys[n]
        moved[at] = values[n]
        row[digit] += 1


SPLATS_AHEAD = 16
"""Splats ahead of the current one whose scattered values are prefetched."""


@part_jit
def _prefetch_rect(rect, order, n, past):
    """Ask memory for the bounds of the splat SPLATS_AHEAD after the n-th in order: they lie
    anywhere."""
    ahead = order[min(n + np.uint64(SPLATS_AHEAD), past - np.uint64(1))]
    prefetch(rect, np.uint64(ahead) * np.uint64(4))


@inline_jit
def _tiles_of(rect, i, tiles_x):
    """The first tile of splat i, how many it has in a row of tiles, and how many in all."""
    width = np.uint64(rect[i, 2] - rect[i, 0])
    height = np.uint64(rect[i, 3] - rect[i, 1])
    return np.uint64(rect[i, 1] * tiles_x + rect[i, 0]), width, width * height


@inline_jit
def _next_tile(tile, column, width, tiles_x):
    """The splat's tile after `tile`, its column-th in the row, and its column. One loop over all of
    them, without a branch at the end of a row, is a fourth faster than two: the processor cannot
    foresee where short loops end."""
    is_last = column == width
    one = np.uint64(1)
    step = np.uint64(tiles_x) - width + one if is_last else one
    return tile + step, one if is_last else column + one


@inline_jit
def _count_pairs(k, rect, order, tiles_x, row):
    """Write to `row` (tiles,) how many splats of part k overlap each tile. `order` (M,) are the
    numbers of the splats, sorted from near to far; part k is the k-th of SORT_PARTS."""
    row[:] = 0
    past = np.uint64((k + 1) * len(order) // SORT_PARTS)
    for n in range(np.uint64(k * len(order) // SORT_PARTS), past):
        _prefetch_rect(rect, order, n, past)
        i = np.uint64(order[n])
        tile, width, total = _tiles_of(rect, i, tiles_x)
        column = np.uint64(1)
        for _ in range(total):
            row[tile] += 1
            tile, column = _next_tile(tile, column, width, tiles_x)


@inline_jit
def _arrange_tiles(counts, tile_blocks, start, tiles):
    """Turn the counts of `_count_pairs` into the offset of each part's pairs in each tile's list;
    write start (tiles + 1,), where these begin, and the tiles to be rendered. Returns how many."""
    start[:] = _sum_counts(counts)
    count = 0
    for tile in range(len(tile_blocks)):
        tiles[count] = tile
        count += tile_blocks[tile] != 0
    tiles[:count] = heaviest_first(tiles[:count], start)
    return count


@part_jit
def heaviest_first(tiles, start):
    """Reorder tiles (T,) int32 in runs of neighbors, those of the most pairs first, RUN_BUCKETS
    kinds of them: what is left at the end is short."""
    runs = len(tiles) // RUN_TILES
    pairs = np.zeros(runs, np.int64)
    places = np.zeros(RUN_BUCKETS + 1, np.int64)
    most = 1
    for n in range(runs * RUN_TILES):
        pairs[n // RUN_TILES] += start[tiles[n] + 1] - start[tiles[n]]
        most = max(most, pairs[n // RUN_TILES])
    for n in range(runs):
        pairs[n] = (most - pairs[n]) * (RUN_BUCKETS - 1) // most
        places[pairs[n] + 1] += 1
    for n in range(RUN_BUCKETS):
        places[n + 1] += places[n]
    ordered = tiles.copy()
    for n in range(runs):
        first = places[pairs[n]] * RUN_TILES
        places[pairs[n]] += 1
        for k in range(RUN_TILES):
            ordered[first + k] = tiles[n * RUN_TILES + k]
    return ordered


@inline_jit
def _fill_pairs(k, rect, order, tiles_x, row, lists):
    """Write part k's pairs to every tile's list; `row` holds its offsets of `_arrange_tiles` and is
    advanced."""
    first_pair = lists.first_pair
    splat_pairs = lists.splat_pairs
    pair_splat = lists.pair_splat
    past = np.uint64((k + 1) * len(order) // SORT_PARTS)
    for n in range(np.uint64(k * len(order) // SORT_PARTS), past):
        _prefetch_rect(rect, order, n, past)
        i = np.uint64(order[n])
        tile, width, total = _tiles_of(rect, i, tiles_x)
        first = np.uint64(first_pair[i])
        column = np.uint64(1)
        for found in range(first, first + total):
            at = row[tile]
            row[tile] = at + 1
            pair_splat[np.uint64(at)] = i
            splat_pairs[found] = at
            tile, column = _next_tile(tile, column, width, tiles_x)


def whole_tiles(count: int) -> np.ndarray:
    """`find_needed_blocks` of an image of `count` tiles that is needed everywhere."""
    return np.full(count, (1 << BLOCKS) - 1, np.uint16)


@part_jit
def _cell(pixel, size, cells):
    """The cell of `size` pixels that a coordinate, float32, lies in, of so many cells."""
    return np.int64(min(np.float32(cells), max(np.float32(0.0), np.floor(pixel / size))))


@part_jit
def _add_box(count, x0, y0, x1, y1):
    """Count one more from (x0, y0) to before (x1, y1), as differences between neighbors: four
    whatever the size."""
    count[y0, x0] += 1
    count[y0, x1] -= 1
    count[y1, x0] -= 1
    count[y1, x1] += 1


@part_jit
def _sum_boxes(count):
    """Turn the differences of `_add_box` into counts."""
    for y in range(1, count.shape[0]):
        for x in range(count.shape[1]):
            count[y, x] += count[y - 1, x]
    for y in range(count.shape[0]):
        along = 0
        for x in range(count.shape[1]):
            along += count[y, x]
            count[y, x] = along


@jit
def listed_rows(rows, wanted):
    """Those of the rows (M,) int32 that are wanted (N,) bool."""
    found = np.empty(len(rows), np.int32)
    count = 0
    for n in range(np.uint64(len(rows))):
        found[count] = rows[n]
        count += wanted[np.uint64(rows[n])]
    return found[:count]


def sum_tiles(tiles: np.ndarray) -> np.ndarray:
    """How many of the marked tiles (tiles_y, tiles_x) bool are above and to the left (tiles_y + 1,
    tiles_x + 1)."""
    covered = np.zeros((tiles.shape[0] + 1, tiles.shape[1] + 1), np.int32)
    tiles.cumsum(0, np.int32).cumsum(1, out=covered[1:, 1:])
    return covered


@jit
def find_needed_blocks(projection, splats, reach, tiles_x, tiles_y):
    """The tiles that the listed splats (M,) reach, and the blocks of tiles in which a pixel may be
    at most `reach` pixels, float32, away from one that they reach.

    Returns touched (tiles_y, tiles_x) bool, the tiles that they reach; `sum_tiles` of those with a
    needed block; and tile_blocks (tiles,) uint16: a bit each, in the order of `blend.BLOCKS`.
    """
    projected = projection.columns
    extent_y = projection.extent_y
    rect = projection.rect
    side = np.float32(SIDE)
    slack = np.float32(1e-4)
    columns = BLOCKS_ALONG * tiles_x
    rows = BLOCKS_ALONG * tiles_y
    near = np.zeros((rows + 1, columns + 1), np.int32)
    reached = np.zeros((tiles_y + 1, tiles_x + 1), np.int32)
    for n in range(len(splats)):
        i = np.uint64(splats[n])
        if rect[i, 2] <= rect[i, 0]:
            continue
        _add_box(reached, rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3])
        x = projected[i, MEAN_X]
        y = projected[i, MEAN_Y]
        ey = extent_y[i]
        shear = projected[i, SHEAR]
        ex = ey * math.sqrt(projected[i, PRECISION_Y] / projected[i, PRECISION_X] + shear * shear)
        ex = ex + slack * ex + reach + np.float32(0.5)
        ey = ey + slack * ey + reach + np.float32(0.5)
        x0 = _cell(x - ex, side, columns)
        x1 = _cell(x + ex + side, side, columns)
        _add_box(near, x0, _cell(y - ey, side, rows), x1, _cell(y + ey + side, side, rows))
    _sum_boxes(reached)
    _sum_boxes(near)
    tile_blocks = np.zeros(tiles_y * tiles_x, np.uint16)
    covered = np.zeros((tiles_y + 1, tiles_x + 1), np.int32)
    for ty in range(tiles_y):
        for tx in range(tiles_x):
            bits = np.uint16(0)
            for bit in range(BLOCKS):
                row = ty * BLOCKS_ALONG + bit % BLOCKS_ALONG
                column = tx * BLOCKS_ALONG + bit // BLOCKS_ALONG
                bits |= np.uint16((near[row, column] > 0) << bit)
            tile_blocks[ty * tiles_x + tx] = bits
            covered[ty + 1, tx + 1] = bits != 0
    _sum_boxes(covered)
    return reached[:-1, :-1] > 0, covered, tile_blocks


@jit
def box_groups(tiles, most_rows):
    """Boxes (B, 4) int64 x0, y0, x1, y1 around each connected group of marked tiles (rows, columns)
    bool; a group of more than `most_rows` rows is cut into bands of about as many rows each."""
    rows, columns = tiles.shape
    group = np.zeros((rows, columns), np.int64)
    waiting = np.empty((rows * columns, 2), np.int64)
    boxes = np.empty((rows * columns, 4), np.int64)
    count = 0
    for y in range(rows):
        for x in range(columns):
            if not tiles[y, x] or group[y, x] != 0:
                continue
            number = count + 1
            group[y, x] = number
            waiting[0, 0] = y
            waiting[0, 1] = x
            left = 1
            past = y + 1
            while left > 0:
                left -= 1
                row = waiting[left, 0]
                column = waiting[left, 1]
                past = max(past, row + 1)
                for v in range(max(0, row - 1), min(rows, row + 2)):
                    for u in range(max(0, column - 1), min(columns, column + 2)):
                        if tiles[v, u] and group[v, u] == 0:
                            group[v, u] = number
                            waiting[left, 0] = v
                            waiting[left, 1] = u
                            left += 1
            bands = (past - y + most_rows - 1) // most_rows
            for band in range(bands):
                box = boxes[count]
                box[0] = columns
                box[2] = 0
                box[1] = y + (past - y) * band // bands
                box[3] = y + (past - y) * (band + 1) // bands
                for v in range(box[1], box[3]):
                    for u in range(columns):
                        if group[v, u] == number:
                            box[0] = min(box[0], u)
                            box[2] = max(box[2], u + 1)
                count += 1
    return boxes[:count]
