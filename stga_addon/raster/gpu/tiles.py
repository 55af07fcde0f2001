"""Sorting of projected splats into tiles, front to back; the counterpart of `cpu/tiles.py`.

The splats are sorted by depth, write their (tile, splat) pairs in that order, and a stable sort by tile alone keeps
it: two short sorts (32 bits of N depths, a dozen bits of the pairs) instead of a long one.

How many pairs there are is known on the device only. The buffers for them have a fixed capacity, what does not fit is
not written, and everything that follows then finds nothing to do, so that the host may ask later and repeat.
"""

import warp as wp

from ..cpu.layout import TILE as _TILE

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(_TILE)
MARKED, UNMARKED = wp.constant(wp.uint8(1)), wp.constant(wp.uint8(0))


@wp.kernel
def mark_tiles(
    rect: wp.array[wp.vec4i], focus: wp.array[wp.uint8], tiles_x: wp.int32, touched: wp.array[wp.uint8]
):  # fmt: skip
    """Set the tiles that a splat of focus (N,) reaches; all who write one write the same."""
    i = wp.tid()
    if focus[i] == UNMARKED:
        return
    r = rect[i]
    for y in range(r[1], r[3]):
        for x in range(r[0], r[2]):
            touched[y * tiles_x + x] = MARKED


@wp.kernel
def dilate_tiles(
    touched: wp.array[wp.uint8], tiles_x: wp.int32, tiles_y: wp.int32, ring: wp.int32, rendered: wp.array[wp.uint8]
):  # fmt: skip
    """Mark the tiles with a touched one at most `ring` tiles away."""
    n = wp.tid()
    x, y = n % tiles_x, n // tiles_x
    near = UNMARKED
    for row in range(wp.max(0, y - ring), wp.min(tiles_y, y + ring + 1)):
        for column in range(wp.max(0, x - ring), wp.min(tiles_x, x + ring + 1)):
            near = wp.max(near, touched[row * tiles_x + column])
    rendered[n] = near


@wp.kernel
def count_pairs(
    order: wp.array[wp.int32],
    rect: wp.array[wp.vec4i],
    rendered: wp.array[wp.uint8],
    tiles_x: wp.int32,
    count: wp.array[wp.int32],
):
    """How many rendered tiles the n-th splat in `order` touches."""
    n = wp.tid()
    r = rect[order[n]]
    pairs = int(0)
    for y in range(r[1], r[3]):
        for x in range(r[0], r[2]):
            pairs += int(rendered[y * tiles_x + x])
    count[n] = pairs


@wp.kernel
def fill_pairs(
    order: wp.array[wp.int32],
    rect: wp.array[wp.vec4i],
    rendered: wp.array[wp.uint8],
    tiles_x: wp.int32,
    count: wp.array[wp.int32],
    end: wp.array[wp.int32],
    focus: wp.array[wp.uint8],
    capacity: wp.int32,
    pair_tile: wp.array[wp.int32],
    pair_slot: wp.array[wp.int32],
    slot_splat: wp.array[wp.int32],
    slot_start: wp.array[wp.int32],
    slot_count: wp.array[wp.int32],
    wanted: wp.array[wp.uint8],
):
    """Write the n-th splat's pairs to its slots, end[n] − count[n] and on.

    pair_tile and pair_slot (≥ capacity) are keys and values ready to be sorted; slot_start, slot_count (N,) are by
    splat. wanted (N,): splats of focus (N,) that are visible. Where the last end exceeds the capacity nothing fits.
    """
    n = wp.tid()
    i = order[n]
    all_pairs = end[end.shape[0] - 1]
    fits = all_pairs >= 0 and all_pairs <= capacity  # a count beyond 2³¹ has become negative
    pairs = wp.where(fits, count[n], 0)
    slot = end[n] - count[n]
    slot_start[i] = wp.where(fits, slot, 0)
    slot_count[i] = pairs
    wanted[i] = wp.where(pairs > 0, focus[i], UNMARKED)
    if pairs == 0:
        return
    r = rect[i]
    for y in range(r[1], r[3]):
        for x in range(r[0], r[2]):
            tile = y * tiles_x + x
            if rendered[tile] == MARKED:
                pair_tile[slot] = tile
                pair_slot[slot] = slot
                slot_splat[slot] = i
                slot += 1


@wp.kernel
def find_tiles(
    pair_tile: wp.array[wp.int32],
    pair_slot: wp.array[wp.int32],
    slot_splat: wp.array[wp.int32],
    pair_splat: wp.array[wp.int32],
    first: wp.array[wp.int32],
    past: wp.array[wp.int32],
):
    """From the sorted pairs: each pair's splat, and where each tile's list begins and ends.

    Unused places at the end have a tile beyond the last. first, past (tiles,) are zero where a tile has no pairs.
    """
    j = wp.tid()
    tile = pair_tile[j]
    if tile >= first.shape[0]:
        return
    pair_splat[j] = slot_splat[pair_slot[j]]
    if j == 0 or pair_tile[wp.max(j - 1, 0)] != tile:
        first[tile] = j
    if j + 1 == pair_splat.shape[0] or pair_tile[wp.min(j + 1, pair_splat.shape[0] - 1)] != tile:
        past[tile] = j + 1
