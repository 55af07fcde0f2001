"""Sorting of projected splats into tiles, front to back."""

import math

import numpy as np

from . import inline_jit, jit, part_jit
from .blend import BLOCKS, BLOCKS_ALONG, RUN_TILES, SIDE
from .elementary import prefetch
from .layout import MEAN_X, MEAN_Y, PRECISION_X, PRECISION_Y, SHEAR
from .threads import parallel, pieces

RADIX_BITS = 11
DIGITS = 1 << RADIX_BITS
SPLATS_PER_SORT = 4_096
"""Splats that a thread lists or sorts at a time."""
SORT_PARTS = 16
"""Parallel parts: the splats, sorted near to far, are cut into as many of equal length."""
SPLATS, PAIRS, LEAST, GREATEST = range(4)
"""Columns of what `list_visible` finds in a part: splats with a tile, their pairs, and the bounds
of their keys."""
RUN_BUCKETS = 512
"""Kinds of runs of tiles, by how many pairs they have."""


@inline_jit
def _digit(key, least, shift):
    return np.uint64((np.uint32(key - least) >> shift) & np.uint32(DIGITS - 1))


@parallel(lambda rect, *_: parts_of(len(rect)))
def list_visible(work, rect, depth_bits, found, keys, pairs, first_pair, parts, counts):
    """List the splats with tiles in their bounds, rect (N, 4), by parts of SPLATS_PER_SORT splats.

    Writes from each part's first place on its visible splats to found (N,) int32, and their keys,
    the bits of their depths (N,), to keys (N,) uint32. pairs, first_pair (N,) int32: how many pairs
    each splat has, and how many in its part come before. parts (parts + 1, 4) int64: see SPLATS.
    counts (parts, DIGITS) int32: of the keys' lowest digits.
    """
    for part, past_part in pieces(work):
        for k in range(part, past_part):
            row = counts[k]
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
                seen = width > 0
                found[begin + count] = i
                keys[begin + count] = key
                pairs[i] = width * (rect[i, 3] - rect[i, 1])
                first_pair[i] = before
                count = count + np.uint64(seen)
                before = np.int32(before + pairs[i])
                row[_digit(key, np.uint32(0), np.uint32(0))] += seen
                least = min(least, key if seen else least)
                greatest = max(greatest, key if seen else greatest)
            parts[k, SPLATS] = count
            parts[k, PAIRS] = before
            parts[k, LEAST] = least
            parts[k, GREATEST] = greatest


def parts_of(splats: int) -> int:
    """How many parts of SPLATS_PER_SORT splats there are."""
    return -(-splats // SPLATS_PER_SORT)


@jit
def sum_parts(parts, counts):
    """Turn the splats and pairs of `list_visible`'s parts into those of the parts before, with a
    last row of all, and its counts of digits into places.

    Returns what all keys are counted from, of lowest digit 0, so that a key's lowest digit is its
    own, and the greatest of the keys counted from there.
    """
    splats = 0
    pairs = 0
    least = 0xFFFFFFFF
    greatest = 0
    last = len(parts) - 1
    for k in range(last):
        count = parts[k, SPLATS]
        before = parts[k, PAIRS]
        parts[k, SPLATS] = splats
        parts[k, PAIRS] = pairs
        splats = splats + count
        pairs = pairs + before
        least = min(least, parts[k, LEAST])
        greatest = max(greatest, parts[k, GREATEST])
    parts[last, SPLATS] = splats
    parts[last, PAIRS] = pairs
    sum_counts(counts)
    least = least // DIGITS * DIGITS
    return least, max(0, greatest - least)


@jit
def sum_counts(counts):
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


@parallel(lambda parts, *_: len(parts) - 1)
def move_visible(work, parts, found, keys, place, first_pair, visible, moved_keys, moved):
    """Write the splats of `list_visible`, M in all, to visible (M,), and with their keys sorted by
    the lowest digit to moved (M,) and moved_keys (M,).

    parts and `place`, the places of digits, as of `sum_parts`; `place` is advanced. first_pair
    (N,): from now on counts the pairs of the parts before as well.
    """
    for part, past_part in pieces(work):
        for k in range(part, past_part):
            row = place[k]
            begin = np.uint64(k * SPLATS_PER_SORT)
            first = np.uint64(parts[k, SPLATS])
            before = np.int32(parts[k, PAIRS])
            for n in range(np.uint64(parts[k + 1, SPLATS] - parts[k, SPLATS])):
                i = found[begin + n]
                key = keys[begin + n]
                visible[first + n] = i
                first_pair[np.uint64(i)] += before
                digit = _digit(key, np.uint32(0), np.uint32(0))
                at = np.uint64(row[digit])
                moved_keys[at] = key
                moved[at] = i
                row[digit] += 1


@parallel(lambda counts, *_: len(counts))
def count_digits(work, counts, keys, least, shift):
    """Count in each part of the keys (M,) uint32, SPLATS_PER_SORT long, how often each digit
    occurs.

    The digit is that of the key minus `least`, from bit `shift` on, both uint32. counts (parts,
    DIGITS) int32.
    """
    for part, past_part in pieces(work):
        for k in range(part, past_part):
            row = counts[k]
            row[:] = 0
            past = min(len(keys), (k + 1) * SPLATS_PER_SORT)
            for n in range(np.uint64(k * SPLATS_PER_SORT), np.uint64(past)):
                row[_digit(keys[n], least, shift)] += 1


@parallel(lambda counts, *_: len(counts))
def move_by_digit(work, place, keys, values, least, shift, moved_keys, moved):
    """Write keys and values (M,) sorted by a digit; `place` holds the places of `sum_counts` and is
    advanced."""
    for part, past_part in pieces(work):
        for k in range(part, past_part):
            row = place[k]
            past = min(len(keys), (k + 1) * SPLATS_PER_SORT)
            for n in range(np.uint64(k * SPLATS_PER_SORT), np.uint64(past)):
                digit = _digit(keys[n], least, shift)
                at = np.uint64(row[digit])
                moved_keys[at] = keys[n]
                moved[at] = values[n]
                row[digit] += 1


SPLATS_AHEAD = 16
"""So many splats ahead, memory is asked for what lies in no order."""


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


@parallel(lambda *_: SORT_PARTS)
def count_pairs(work, rect, order, tiles_x, counts):
    """Count the (splat, tile) pairs of each part of order (M,) int32: the splats, near to far.

    rect (N, 4) int32 tile bounds. Writes counts (SORT_PARTS, tiles) int32.
    """
    for part, past_part in pieces(work):
        for k in range(part, past_part):
            row = counts[k]
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


@jit
def arrange_tiles(counts, tile_blocks):
    """Turn the counts of `count_pairs` into the offset of each part's pairs in each tile's list.

    tile_blocks (tiles,) as of `find_needed_blocks`. Returns start (tiles + 1,) int64: where each
    tile's list begins, and tiles (T,) int32: those with a needed block, in the order in which they
    are rendered.
    """
    start = sum_counts(counts)
    tiles = np.empty(len(tile_blocks), np.int32)
    count = 0
    for tile in range(len(tile_blocks)):
        tiles[count] = tile
        count += tile_blocks[tile] != 0
    return start, heaviest_first(tiles[:count], start)


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


@parallel(lambda *_: SORT_PARTS)
def fill_pairs(work, rect, order, tiles_x, place, first_pair, splat_pairs, pair_splat):
    """Write every tile's pairs front to back; `place` holds the offsets of `arrange_tiles` and is
    advanced.

    pair_splat (P,) int32: whose pair it is. splat_pairs (P,) int32: where the pairs of a splat
    stand, its first at first_pair[i].
    """
    for part, past_part in pieces(work):
        for k in range(part, past_part):
            row = place[k]
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
    for y in range(count.shape[0]):
        along = 0
        for x in range(count.shape[1]):
            along += count[y, x]
            count[y, x] = along + (count[y - 1, x] if y > 0 else 0)


@jit
def split_splats(focus):
    """The splats (M,) int64 that are in focus (N,) bool, and the others."""
    inside = np.empty(len(focus), np.int64)
    outside = np.empty(len(focus), np.int64)
    found = 0
    for i in range(np.uint64(len(focus))):
        inside[found] = outside[i - np.uint64(found)] = i
        found += focus[i]
    return inside[:found], outside[: len(focus) - found]


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
    for row in range(rows):
        for column in range(columns):
            bit = column % BLOCKS_ALONG * BLOCKS_ALONG + row % BLOCKS_ALONG
            tile = row // BLOCKS_ALONG * tiles_x + column // BLOCKS_ALONG
            tile_blocks[tile] |= np.uint16((near[row, column] > 0) << bit)
    for ty in range(tiles_y):
        for tx in range(tiles_x):
            covered[ty + 1, tx + 1] = tile_blocks[ty * tiles_x + tx] != 0
    _sum_boxes(covered)
    return reached[:-1, :-1] > 0, covered, tile_blocks


def box_groups(tiles: np.ndarray, most_rows: int) -> np.ndarray:
    """Boxes (B, 4) int64 x0, y0, x1, y1 around each connected group of marked tiles (rows, columns)
    bool, the largest first; a group of more than `most_rows` rows is cut into bands of about as
    many rows each."""
    from scipy import ndimage  # which rendering does not need

    numbers, _ = ndimage.label(tiles, np.ones((3, 3)))
    boxes = []
    for number, (rows, _) in enumerate(ndimage.find_objects(numbers), 1):
        first = rows.start
        count = rows.stop - rows.start
        bands = -(-count // most_rows)
        for band in range(bands):
            y0 = first + count * band // bands
            y1 = first + count * (band + 1) // bands
            columns = np.flatnonzero((numbers[y0:y1] == number).any(0))
            boxes.append((columns[0], y0, columns[-1] + 1, y1))
    boxes.sort(key=lambda box: (box[0] - box[2]) * (box[3] - box[1]))
    return np.array(boxes, np.int64).reshape(-1, 4)
