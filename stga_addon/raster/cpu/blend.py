"""Alpha blending of the splats of each 16×16 tile, forward and backward.

A pixel takes splats front to back and stops before the one that would leave ≤ 1e-4 transmittance.
The forward stores each pixel's last contributing pair and the backward obeys it, so transmittance
never underflows behind many opaque splats.

The unit of work is a block of 4×4 pixels that a splat reaches. The blocks of several splats are
listed first, and each step then is one loop over the list: loops over the pixels of one splat are
so short that the processor loses more time where they end than in them. A block's 16 pixels are one
to four vectors on every processor.

Loops over pixels neither load nor store under a condition: NEON and AVX2 have no fast instruction
for either, so LLVM would emit masked stores or no vectors at all. Both sides of a choice are
computed, and every pixel is stored.
"""

import math

import numpy as np

from . import inline_jit, layout, part_jit
from .elementary import prefetch
from .layout import PIXELS, PROJECTED, TILE
from .threads import call_helpers, parallel, pieces

MAX_ALPHA = np.float32(0.999)
"""Largest alpha of a splat at a pixel, as in gsplat."""
MIN_ALPHA = np.float32(1 / 255)
"""Alpha of one step of 8 bits: below, a splat adds nothing to a pixel."""
MIN_TRANSMITTANCE = np.float32(1e-4)
"""Least transmittance of a pixel: it stops before the splat that would leave no more."""
LOG2E = np.float32(1.4426950408889634)
"""log₂ e, which makes e^x a power of 2: e^x = 2^(x · log₂ e)."""
SIDE = 4
"""Side of a block in pixels."""
BLOCK_PIXELS = SIDE * SIDE
"""Pixels of a block, which are stored one after the other, row by row."""
BLOCKS_ALONG = TILE // SIDE
"""Blocks along the side of a tile."""
BLOCKS = BLOCKS_ALONG * BLOCKS_ALONG
"""Blocks of a tile, stored column by column."""
PAIRS_PER_GROUP = 8
"""Splats whose blocks are listed together; after each group, the forward pass drops the blocks that
are behind something opaque."""
LISTED = PAIRS_PER_GROUP * BLOCKS
"""Largest number of blocks in a list."""
FORWARD_SIZE = 8 * PIXELS + LISTED * BLOCK_PIXELS
"""Values in a tile's flat array in the forward pass."""
BACKWARD_SIZE = 8 * PIXELS + 7 * LISTED * BLOCK_PIXELS
"""Values in a tile's flat array in the backward pass."""
BATCH_PAIRS = 32
"""Splats of a tile that are copied at a time, while memory is asked for the next ones, which lie
all over it."""
BATCH_SIZE = 13 * BATCH_PAIRS
"""Values in a batch's flat array."""
RUN_TILES = 4
"""Tiles that the same thread renders one after the other: neighbors share splats."""

# Where a pixel's values lie in the tile's flat array. Unsigned, because a signed index that may be
# negative wraps around in Python, and the test for it keeps LLVM from vectorizing (12 times
# slower). The first values are the transmittance: in the forward pass negative once the pixel has
# stopped.
SUM_RED, SUM_GREEN, SUM_BLUE, LAST, X, Y, BEHIND = (np.uint64(n * PIXELS) for n in range(1, 8))
V_RED = SUM_RED
V_GREEN = SUM_GREEN
V_BLUE = SUM_BLUE
# Behind the tile's values, those of the listed blocks; the forward pass has only the first.
(ALPHA, DX, DY, V_POWER, PART_RED, PART_GREEN, PART_BLUE) = (
    np.uint64(8 * PIXELS + n * LISTED * BLOCK_PIXELS) for n in range(7)
)  # fmt: skip
# Column c of a batch's splat q lies at c·BATCH_PAIRS + q of a flat array, so that `_find_blocks`
# works in vectors.
(AT_MEAN_X, AT_MEAN_Y, AT_PRECISION_X, AT_SHEAR, AT_PRECISION_Y, AT_OPACITY, AT_RED, AT_GREEN,
 AT_BLUE, AT_EXTENT_Y, AT_RATE_X, AT_RATE_Y, AT_BLOCKS) = (
    np.uint64(n * BATCH_PAIRS) for n in range(13))  # fmt: skip

ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)


@inline_jit
def _exp2(x):
    """2^x for x ≤ 0 to 2e-7 relative: exponent bits by shift, the fraction by a degree-5
    polynomial."""
    x = max(x, np.float32(-120.0))
    whole = np.floor(x)
    f = x - whole
    p = np.float32(1.8775767e-3)
    p = p * f + np.float32(8.9893397e-3)
    p = p * f + np.float32(5.5826318e-2)
    p = p * f + np.float32(2.4015361e-1)
    p = p * f + np.float32(6.9315308e-1)
    p = p * f + np.float32(9.9999994e-1)
    return p * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)


@part_jit
def _prefetch_batch(pair_splat, first, past, projected):
    """Ask memory for the projected splats of the pairs from `first` to `past`: each in one or two
    cache lines."""
    for j in range(np.uint64(first), np.uint64(past)):
        row = np.uint64(pair_splat[j]) * np.uint64(PROJECTED)
        prefetch(projected, row)
        prefetch(projected, row + np.uint64(PROJECTED - 1))


@part_jit
def _copy_batch(pair_splat, first, count, projected, corner, batch):
    """Copy the projected splats of `count` pairs from `first` on; centers relative to the tile's
    corner (x, y)."""
    x0, y0 = corner
    for q in range(np.uint64(count)):
        i = np.uint64(pair_splat[np.uint64(first) + q])
        batch[AT_MEAN_X + q] = projected[i, layout.MEAN_X] - x0
        batch[AT_MEAN_Y + q] = projected[i, layout.MEAN_Y] - y0
        batch[AT_PRECISION_X + q] = projected[i, layout.PRECISION_X]
        batch[AT_SHEAR + q] = projected[i, layout.SHEAR]
        batch[AT_PRECISION_Y + q] = projected[i, layout.PRECISION_Y]
        batch[AT_OPACITY + q] = projected[i, layout.OPACITY]
        batch[AT_RED + q] = projected[i, layout.RED]
        batch[AT_GREEN + q] = projected[i, layout.GREEN]
        batch[AT_BLUE + q] = projected[i, layout.BLUE]
        batch[AT_RATE_X + q] = np.float32(-0.5) * LOG2E * projected[i, layout.PRECISION_X]
        batch[AT_RATE_Y + q] = np.float32(-0.5) * LOG2E * projected[i, layout.PRECISION_Y]


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
    lean = shear * extent_y
    rate = precision_x * shear * shrink
    cut = precision_x * precision_y * shrink * shrink
    return mean_x - HALF, mean_y - HALF, extent_y, lean, rate, chord, cut, slack


@part_jit
def rows_within(outline, left, width, rows):
    """First row and end (past the last) of a range that contains each of rows 0 to `rows` in which
    an outline covers the center of a pixel in the `width` columns from `left` on. All float32.

    Slack for rounding may add rows to the range; it is empty where first ≥ end. Upward, the ellipse
    extends farthest in one column, and less the farther a column is from that one: among `width`
    columns, the nearest to it counts. Likewise downward.
    """
    center_x, center_y, extent_y, lean, rate, chord, cut, slack = outline
    left_x = left - center_x
    right_x = left_x + width - ONE
    nearest_x = min(max(ZERO, left_x), right_x)
    highest_x = min(max(-lean, left_x), right_x)
    lowest_x = min(max(lean, left_x), right_x)
    above = rate * highest_x - math.sqrt(max(ZERO, chord - cut * highest_x * highest_x)) - slack
    below = rate * lowest_x + math.sqrt(max(ZERO, chord - cut * lowest_x * lowest_x)) + slack
    first = np.ceil(max(ZERO, center_y + max(above, -extent_y)))
    end = np.floor(min(rows - ONE, center_y + min(below, extent_y))) + ONE
    reached = cut * nearest_x * nearest_x <= np.float32(1.00001) * chord
    return min(first, rows) if reached else rows, max(end, ZERO) if reached else ZERO


@part_jit
def _find_blocks(count, batch):
    """Set AT_BLOCKS to the blocks of the tile that each splat of a batch reaches, a bit each."""
    rows = np.float32(TILE)
    side = np.float32(SIDE)
    one = np.int32(1)
    for q in range(np.uint64(count)):
        ellipse = outline(
            batch[AT_MEAN_X + q],
            batch[AT_MEAN_Y + q],
            batch[AT_PRECISION_X + q],
            batch[AT_SHEAR + q],
            batch[AT_PRECISION_Y + q],
            batch[AT_EXTENT_Y + q],
        )
        bits = np.int32(0)
        for column in range(BLOCKS_ALONG):
            first, end = rows_within(ellipse, np.float32(column * SIDE), side, rows)
            low = np.int32(np.floor(first / side))
            high = np.int32(np.ceil(end / side))
            reached = np.int32(
                max(np.int32(0), np.int32(np.int32(one << high) - np.int32(one << low)))
            )
            bits = np.int32(bits | np.int32(reached << np.int32(column * BLOCKS_ALONG)))
        batch[AT_BLOCKS + q] = np.float32(bits)  # of 16 bits, exact


@part_jit
def _blocks_alive(s):
    """The blocks of the tile in which a pixel has not stopped, a bit each."""
    found = np.uint16(0)
    for block in range(BLOCKS):
        begin = np.uint64(block * BLOCK_PIXELS)
        bits = np.int32(-1)
        for p in range(np.uint64(BLOCK_PIXELS)):
            bits &= np.float32(s[begin + p]).view(np.int32)
        found |= np.uint16(bits >= 0) << np.uint16(block)  # not all sign bits are set
    return np.uint16(found)


@part_jit
def _list_blocks(listed, count, q, reached):
    """Append the blocks of splat q of a batch to the list; returns how many it then holds. One is
    q·256 + the index of its first pixel. Without a branch: the processor could not foresee which
    bits are set."""
    for block in range(np.uint64(BLOCKS)):
        listed[count] = np.uint16(q * np.uint64(PIXELS) + block * np.uint64(BLOCK_PIXELS))
        count += (np.uint64(reached) >> block) & np.uint64(1)
    return count


@part_jit
def _pixel(column, row):
    """Where the pixel of a tile stands in its flat array."""
    block = column // SIDE * BLOCKS_ALONG + row // SIDE
    return np.uint64(block * BLOCK_PIXELS + row % SIDE * SIDE + column % SIDE)


@part_jit
def _set_coordinates(s):
    """Write the centers of a tile's pixels, relative to its corner."""
    for row in range(TILE):
        for column in range(TILE):
            p = _pixel(column, row)
            s[X + p] = np.float32(column) + np.float32(0.5)
            s[Y + p] = np.float32(row) + np.float32(0.5)


@inline_jit
def _listed(listed, n):
    """The n-th listed block: its splat, its first pixel in the tile, and where its values begin.
    The bounds show LLVM that these do not overlap the tile's."""
    entry = np.uint64(listed[n])
    at = (n % np.uint64(LISTED)) * np.uint64(BLOCK_PIXELS)
    return entry // np.uint64(PIXELS), entry % np.uint64(PIXELS), at


@inline_jit
def _falloff(count, listed, batch, keeps_offsets, s):
    """Write opacity · exp(power) of the listed blocks to s[ALPHA], and if wished the offsets that
    the power is made of to s[DX] and s[DY]. A loop of its own: together with blending, it needs
    more registers than AVX2 has."""
    for n in range(np.uint64(count)):
        q, first, at = _listed(listed, n)
        mean_x = batch[AT_MEAN_X + q]
        mean_y = batch[AT_MEAN_Y + q]
        shear = batch[AT_SHEAR + q]
        qx = batch[AT_RATE_X + q]
        qy = batch[AT_RATE_Y + q]
        opacity = batch[AT_OPACITY + q]
        for p in range(np.uint64(BLOCK_PIXELS)):
            dy = s[Y + first + p] - mean_y
            dx = s[X + first + p] - mean_x - shear * dy
            power = qx * dx * dx + qy * dy * dy
            s[ALPHA + at + p] = opacity * _exp2(power)
            if keeps_offsets:
                s[DX + at + p] = dx
                s[DY + at + p] = dy


@inline_jit
def _blend(count, listed, before, batch, s):
    """Blend the listed blocks; before: how many splats of the tile's list precede the batch's first
    one."""
    for n in range(np.uint64(count)):
        q, first, at = _listed(listed, n)
        red = batch[AT_RED + q]
        green = batch[AT_GREEN + q]
        blue = batch[AT_BLUE + q]
        order = np.float32(before + np.int64(q) + 1).view(np.int32)
        for k in range(np.uint64(BLOCK_PIXELS)):
            p = first + k
            a = min(MAX_ALPHA, s[ALPHA + at + k])
            a = a if a >= MIN_ALPHA else np.float32(0.0)
            t = s[p]
            after = t * (np.float32(1.0) - a)
            continues = after > MIN_TRANSMITTANCE
            weight = a * t if continues else np.float32(0.0)
            s[p] = after if continues else -abs(t)
            s[SUM_RED + p] += weight * red
            s[SUM_GREEN + p] += weight * green
            s[SUM_BLUE + p] += weight * blue
            # Positive floats order like their bits; of integers LLVM takes the maximum without a
            # conditional store.
            reached = order if weight > np.float32(0.0) else np.int32(0)
            s[LAST + p] = np.int32(max(np.float32(s[LAST + p]).view(np.int32), reached)).view(
                np.float32
            )


@part_jit
def _begin_tile(s, needed):
    """Nothing in front of the pixels of a tile's needed blocks, a bit each; those of the others
    have stopped."""
    for p in range(np.uint64(PIXELS)):
        is_needed = (np.uint64(needed) >> (p // np.uint64(BLOCK_PIXELS))) & np.uint64(1)
        s[p] = np.float32(1.0) if is_needed != 0 else np.float32(-1.0)
        s[SUM_RED + p] = s[SUM_GREEN + p] = s[SUM_BLUE + p] = s[LAST + p] = np.float32(0.0)


@part_jit
def _store_empty_tile(left, top, background, blended):
    """Write the pixels of a tile without splats."""
    image = blended.image
    transmittance = blended.transmittance
    last = blended.last
    height, width = last.shape
    red = background[0]
    green = background[1]
    blue = background[2]
    for y in range(np.uint64(top), np.uint64(min(top + TILE, height))):
        for x in range(np.uint64(left), np.uint64(min(left + TILE, width))):
            image[0, y, x] = red
            image[1, y, x] = green
            image[2, y, x] = blue
            transmittance[y, x] = np.float32(1.0)
            last[y, x] = 0


@part_jit
def _store_tile(s, left, top, background, blended):
    """Write the pixels of a tile that are in the image."""
    image = blended.image
    transmittance = blended.transmittance
    last = blended.last
    height, width = last.shape
    for y in range(np.uint64(top), np.uint64(min(top + TILE, height))):
        for x0 in range(left, min(left + TILE, width), SIDE):
            first = _pixel(x0 - left, np.int64(y) - top)
            for column in range(np.uint64(SIDE)):
                p = first + column
                x = np.uint64(x0) + column
                if x >= np.uint64(width):
                    break
                t = abs(s[p])
                image[0, y, x] = s[SUM_RED + p] + t * background[0]
                image[1, y, x] = s[SUM_GREEN + p] + t * background[1]
                image[2, y, x] = s[SUM_BLUE + p] + t * background[2]
                transmittance[y, x] = t
                last[y, x] = np.int32(s[LAST + p])


@parallel(lambda tiles, *_: len(tiles), piece=RUN_TILES)
def blend_forward(work, tiles, tiles_x, tile_blocks, lists, projection, background, blended):
    """Render the listed tiles to `blended`; the tuples are those of `layout.py`.

    tiles (T,) int32 tile numbers, with `tiles_x` tiles a row; tile_blocks (tiles,): their blocks
    that are needed, see `find_needed_blocks`; pixels of the others are undefined. background (3,):
    composited behind the splats.
    """
    call_helpers(work)
    start = lists.start
    pair_splat = lists.pair_splat
    projected = projection.columns
    extent_y = projection.extent_y
    pair_blocks = blended.pair_blocks
    s = np.empty(FORWARD_SIZE, np.float32)
    batch = np.empty(BATCH_SIZE, np.float32)
    listed = np.empty(LISTED + BLOCKS, np.uint16)
    _set_coordinates(s)
    for first_tile, past_tile in pieces(work):
        for k in range(first_tile, past_tile):
            tile = tiles[k]
            left = (tile % tiles_x) * TILE
            top = (tile // tiles_x) * TILE
            begin = start[tile]
            end = start[tile + 1]
            if begin == end:
                _store_empty_tile(left, top, background, blended)
                continue
            _begin_tile(s, tile_blocks[tile])
            for batch_begin in range(begin, end, BATCH_PAIRS):
                alive = _blocks_alive(s)
                if alive == 0:
                    break
                count = min(BATCH_PAIRS, end - batch_begin)
                next_end = min(end, batch_begin + count + BATCH_PAIRS)
                _prefetch_batch(pair_splat, batch_begin + count, next_end, projected)
                for j in range(np.uint64(batch_begin + count), np.uint64(next_end)):
                    prefetch(extent_y, np.uint64(pair_splat[j]))
                corner = (np.float32(left), np.float32(top))
                _copy_batch(pair_splat, batch_begin, count, projected, corner, batch)
                for q in range(np.uint64(count)):
                    i = np.uint64(pair_splat[np.uint64(batch_begin) + q])
                    batch[AT_EXTENT_Y + q] = extent_y[i]
                _find_blocks(count, batch)
                for group in range(0, count, PAIRS_PER_GROUP):
                    if group > 0:
                        alive = _blocks_alive(s)
                    blocks = np.uint64(0)
                    past = min(count, group + PAIRS_PER_GROUP)
                    for q in range(np.uint64(group), np.uint64(past)):
                        reached = np.uint16(np.uint16(batch[AT_BLOCKS + q]) & alive)
                        pair_blocks[np.uint64(batch_begin) + q] = reached
                        blocks = _list_blocks(listed, blocks, q, reached)
                    _falloff(blocks, listed, batch, False, s)
                    _blend(blocks, listed, batch_begin - begin, batch, s)
            _store_tile(s, left, top, background, blended)


@part_jit
def _blocks_of_wanted(first, past, pair_splat, pair_blocks, wanted):
    """The blocks of a tile that the wanted ones of its pairs reach, a bit each."""
    found = np.uint16(0)
    for j in range(np.uint64(first), np.uint64(past)):
        found |= pair_blocks[j] if wanted[pair_splat[j]] else np.uint16(0)
    return np.uint16(found)


@inline_jit
def _unblend(count, listed, before, batch, s):
    """Take the listed blocks off again: the gradient of their power to s[V_POWER], those of the
    splat's color to s[PART_RED], s[PART_GREEN] and s[PART_BLUE]."""
    for n in range(np.uint64(count)):
        q, first, at = _listed(listed, n)
        red = batch[AT_RED + q]
        green = batch[AT_GREEN + q]
        blue = batch[AT_BLUE + q]
        order = np.float32(before + np.int64(q) + 1)
        for k in range(np.uint64(BLOCK_PIXELS)):
            p = first + k
            place = at + k
            raw = s[ALPHA + place]
            a = min(MAX_ALPHA, raw)
            a = a if (a >= MIN_ALPHA) & (order <= s[LAST + p]) else np.float32(0.0)
            ra = np.float32(1.0) / (np.float32(1.0) - a)
            t = s[p] * ra
            weight = a * t
            v_red = s[V_RED + p]
            v_green = s[V_GREEN + p]
            v_blue = s[V_BLUE + p]
            along = red * v_red + green * v_green + blue * v_blue
            v_a = t * along - ra * s[BEHIND + p]
            s[p] = t
            s[BEHIND + p] += weight * along
            s[PART_RED + place] = weight * v_red
            s[PART_GREEN + place] = weight * v_green
            s[PART_BLUE + place] = weight * v_blue
            # d alpha / d power through the clamp is zero; `a` zeroes pixels that this splat does
            # not reach.
            s[V_POWER + place] = a * v_a if raw < MAX_ALPHA else np.float32(0.0)


@inline_jit
def _sum_gradient(first, past, s, sums):
    """Write the sums of a splat's blocks, from value `first` to before `past`: of the power's
    gradient times 1, dx, dy, dx², dx·dy and dy², and of the color's gradients."""
    g0 = gx = gy = gxx = gxy = gyy = red = green = blue = np.float32(0.0)
    for p in range(first, past):
        dx = s[DX + p]
        dy = s[DY + p]
        g = s[V_POWER + p]
        g_dx = g * dx
        g_dy = g * dy
        g0 += g
        gx += g_dx
        gy += g_dy
        gxx += g_dx * dx
        gxy += g_dx * dy
        gyy += g_dy * dy
        red += s[PART_RED + p]
        green += s[PART_GREEN + p]
        blue += s[PART_BLUE + p]
    sums[0] = g0
    sums[1] = gx
    sums[2] = gy
    sums[3] = gxx
    sums[4] = gxy
    sums[5] = gyy
    sums[6] = red
    sums[7] = green
    sums[8] = blue


@part_jit
def _store_pair(grads, j, q, batch, sums):
    """Write the gradient of pair j, splat q of a batch, from the sums of `_sum_gradient`."""
    precision_x = batch[AT_PRECISION_X + q]
    precision_y = batch[AT_PRECISION_Y + q]
    shear = batch[AT_SHEAR + q]
    grads[j, layout.MEAN_X] = precision_x * sums[1]
    grads[j, layout.MEAN_Y] = precision_y * sums[2] - shear * precision_x * sums[1]
    grads[j, layout.PRECISION_X] = np.float32(-0.5) * sums[3]
    grads[j, layout.SHEAR] = precision_x * sums[4]
    grads[j, layout.PRECISION_Y] = np.float32(-0.5) * sums[5]
    grads[j, layout.OPACITY] = sums[0] / batch[AT_OPACITY + q]
    grads[j, layout.RED] = sums[6]
    grads[j, layout.GREEN] = sums[7]
    grads[j, layout.BLUE] = sums[8]


@part_jit
def _load_tile(s, left, top, background, v_pixels, blended):
    """Copy what the backward pass needs of a tile's pixels; v_pixels: the image's gradient and the
    transmittance's. Returns the deepest of their last pairs, counted from 1."""
    v_image, v_transmittance = v_pixels
    transmittance = blended.transmittance
    last = blended.last
    height, width = last.shape
    if left + TILE > width or top + TILE > height:  # pixels outside the image
        for p in range(np.uint64(PIXELS)):
            s[p] = np.float32(1.0)
            s[BEHIND + p] = s[V_RED + p] = s[V_GREEN + p] = s[V_BLUE + p] = s[LAST + p] = (
                np.float32(0.0)
            )
    deepest = np.int32(0)
    for y in range(np.uint64(top), np.uint64(min(top + TILE, height))):
        for x0 in range(left, min(left + TILE, width), SIDE):
            first = _pixel(x0 - left, np.int64(y) - top)
            for column in range(np.uint64(SIDE)):
                p = first + column
                x = np.uint64(x0) + column
                if x >= np.uint64(width):
                    break
                t = transmittance[y, x]
                s[p] = t
                vr = v_image[0, y, x]
                vg = v_image[1, y, x]
                vb = v_image[2, y, x]
                behind = background[0] * vr + background[1] * vg + background[2] * vb
                s[BEHIND + p] = t * (behind + v_transmittance[y, x])
                s[V_RED + p] = vr
                s[V_GREEN + p] = vg
                s[V_BLUE + p] = vb
                s[LAST + p] = np.float32(last[y, x])
                deepest = max(deepest, last[y, x])
    return np.int64(deepest)


@part_jit
def _first_wanted(begin, deepest, pair_splat, wanted):
    """The first wanted one of a tile's pairs: nothing in front of it needs to be walked."""
    nearest = begin
    while nearest < deepest and not wanted[pair_splat[nearest]]:
        nearest += 1
    return nearest


@part_jit
def _list_group(pairs, pair_blocks, stepped, places, listed):
    """List the blocks of a group of a batch's pairs, the deepest first; how many there are.

    pairs: the batch's first pair, the end of the group in the batch, how many it has. stepped: the
    blocks of the tile that are walked through. places: where each pair's blocks begin in values.
    """
    batch_begin, group_end, group = pairs
    blocks = np.uint64(0)
    for n in range(group):
        q = np.uint64(group_end - 1 - n)
        # A frozen one is only stepped through, where a wanted one reaches.
        reached = np.uint16(pair_blocks[np.uint64(batch_begin) + q] & stepped)
        places[n] = blocks * np.uint64(BLOCK_PIXELS)
        blocks = _list_blocks(listed, blocks, q, reached)
    places[group] = blocks * np.uint64(BLOCK_PIXELS)
    return blocks


@parallel(lambda tiles, *_: len(tiles), piece=RUN_TILES)
def blend_backward(
    work,
    tiles,
    tiles_x,
    lists,
    blended,
    wanted,
    projected,
    background,
    v_image,
    v_transmittance,
    pair_gradients,
):
    """Write the gradient of every wanted (tile, splat) pair of the listed tiles to pair_gradients
    (P, PROJECTED).

    wanted (N,) bool: splats whose gradient is needed. projected (N, PROJECTED): the projection's
    columns. v_image (3, H, W), v_transmittance (H, W): gradients of image and transmittance. Each
    pair has a row, so that a sum over a splat's pairs has one order whatever the threads do.
    """
    call_helpers(work)
    pair_splat = lists.pair_splat
    v_pixels = (v_image, v_transmittance)
    s = np.empty(BACKWARD_SIZE, np.float32)
    batch = np.empty(BATCH_SIZE, np.float32)
    sums = np.empty(PROJECTED, np.float32)
    places = np.empty(PAIRS_PER_GROUP + 1, np.uint64)
    listed = np.empty(LISTED + BLOCKS, np.uint16)
    _set_coordinates(s)
    for first_tile, past_tile in pieces(work):
        for k in range(first_tile, past_tile):
            tile = tiles[k]
            left = (tile % tiles_x) * TILE
            top = (tile // tiles_x) * TILE
            begin = lists.start[tile]
            if begin == lists.start[tile + 1]:
                continue
            deepest = begin + _load_tile(s, left, top, background, v_pixels, blended)
            pair_gradients[deepest : lists.start[tile + 1], :] = np.float32(0.0)
            nearest = _first_wanted(begin, deepest, pair_splat, wanted)
            stepped = _blocks_of_wanted(nearest, deepest, pair_splat, blended.pair_blocks, wanted)
            for batch_end in range(deepest, nearest, -BATCH_PAIRS):
                batch_begin = max(nearest, batch_end - BATCH_PAIRS)
                count = batch_end - batch_begin
                before = max(nearest, batch_begin - BATCH_PAIRS)
                _prefetch_batch(pair_splat, before, batch_begin, projected)
                corner = (np.float32(left), np.float32(top))
                _copy_batch(pair_splat, batch_begin, count, projected, corner, batch)
                for group_end in range(count, 0, -PAIRS_PER_GROUP):
                    group = min(group_end, PAIRS_PER_GROUP)
                    pairs = (batch_begin, group_end, group)
                    blocks = _list_group(pairs, blended.pair_blocks, stepped, places, listed)
                    _falloff(blocks, listed, batch, True, s)
                    _unblend(blocks, listed, batch_begin - begin, batch, s)
                    for n in range(group):
                        q = np.uint64(group_end - 1 - n)
                        j = np.uint64(batch_begin) + q
                        if wanted[pair_splat[j]]:
                            _sum_gradient(places[n], places[n + 1], s, sums)
                            _store_pair(pair_gradients, j, q, batch, sums)
