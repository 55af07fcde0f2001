"""Alpha blending of the splats of each 16×16 tile, forward and backward.

A pixel takes splats front to back and stops before the one whose transmittance would be ≤ 1e-4. The forward
stores each pixel's last contributing pair and the backward obeys it, so transmittance never underflows behind
many opaque splats.

Loops over pixels neither load nor store under a condition: NEON and AVX2 have no fast instruction for either, so LLVM
would emit masked stores or no vectors at all. Both sides of a choice are computed, and every pixel is stored.
"""

import numpy as np

from . import inline_jit, jit, part_jit
from .layout import BLUE, GREEN, MEAN_X, MEAN_Y, OPACITY, PIXELS, PRECISION_X, PRECISION_Y, PROJECTED, RED, SHEAR, TILE
from .outline import outline, rows_within
from .threads import parallel

MAX_ALPHA = np.float32(0.999)
MIN_ALPHA = np.float32(1 / 255)
MIN_TRANSMITTANCE = np.float32(1e-4)
LOG2E = np.float32(1.4426950408889634)

# A tile is two halves, eight pixels wide, stored one after the other row by row: a vector of sixteen pixels holds two
# short rows, and where a splat only grazes one half, little of that half is computed.
HALF_WIDTH = TILE // 2
HALF_PIXELS = PIXELS // 2

# Where a pixel's values lie in the tile's flat array. Unsigned, because a signed index that may be negative wraps
# around in Python, and the test for it keeps LLVM from vectorizing (12 times slower).
# The first values are the transmittance: in the forward pass negative once the pixel has stopped.
SUM_RED, SUM_GREEN, SUM_BLUE, LAST, X, Y, ALPHA, WEIGHT, BEHIND = (np.uint64(n * PIXELS) for n in range(1, 10))
V_RED, V_GREEN, V_BLUE, V_POWER = SUM_RED, SUM_GREEN, SUM_BLUE, ALPHA
STATE_SIZE = 10 * PIXELS

# A tile's splats are copied a batch at a time: memory is asked for many of them at once instead of one after the other,
# and the rows that they reach are computed in vectors. Column c of splat q lies at c·BATCH_PAIRS + q of a flat array.
BATCH_PAIRS = 32
PAIRS_PER_ALIVE_CHECK = 8
"""After so many pairs the forward pass looks again which rows are not yet behind something opaque."""
(AT_MEAN_X, AT_MEAN_Y, AT_PRECISION_X, AT_SHEAR, AT_PRECISION_Y, AT_OPACITY, AT_RED, AT_GREEN, AT_BLUE, AT_EXTENT_Y,
 AT_FIRST, AT_PAST, AT_FIRST_RIGHT, AT_PAST_RIGHT) = (np.uint64(n * BATCH_PAIRS) for n in range(14))  # fmt: skip
BATCH_SIZE = 14 * BATCH_PAIRS


@inline_jit
def _exp2(x):
    """2^x for x ≤ 0 to 2e-7 relative: exponent bits by shift, the fraction by a degree-5 polynomial."""
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
def _copy_batch(pair_splat, first, count, projected, x0, y0, batch):
    """Copy the projected splats of `count` pairs from `first` on; centers relative to the tile's corner (x0, y0)."""
    for q in range(np.uint64(count)):
        i = np.uint64(pair_splat[np.uint64(first) + q])
        batch[AT_MEAN_X + q], batch[AT_MEAN_Y + q] = projected[i, MEAN_X] - x0, projected[i, MEAN_Y] - y0
        batch[AT_PRECISION_X + q], batch[AT_SHEAR + q] = projected[i, PRECISION_X], projected[i, SHEAR]
        batch[AT_PRECISION_Y + q], batch[AT_OPACITY + q] = projected[i, PRECISION_Y], projected[i, OPACITY]
        batch[AT_RED + q], batch[AT_GREEN + q] = projected[i, RED], projected[i, GREEN]
        batch[AT_BLUE + q] = projected[i, BLUE]


@part_jit
def _find_rows(count, batch):
    """Which rows of each half of the tile a batch's splats reach: whole vectors of 16 pixels, so pairs of rows."""
    two, rows, width = np.float32(2.0), np.float32(TILE), np.float32(HALF_WIDTH)
    for q in range(np.uint64(count)):
        ellipse = outline(
            batch[AT_MEAN_X + q], batch[AT_MEAN_Y + q], batch[AT_PRECISION_X + q], batch[AT_SHEAR + q],
            batch[AT_PRECISION_Y + q], batch[AT_EXTENT_Y + q],
        )  # fmt: skip
        first, past = rows_within(ellipse, np.float32(0.0), width, rows)
        batch[AT_FIRST + q], batch[AT_PAST + q] = two * np.floor(first / two), two * np.ceil(past / two)
        first, past = rows_within(ellipse, width, width, rows)
        batch[AT_FIRST_RIGHT + q], batch[AT_PAST_RIGHT + q] = two * np.floor(first / two), two * np.ceil(past / two)


@part_jit
def _rows_alive(s, half):
    """First and past-the-last row of a half of the tile in which a pixel has not stopped, in pairs of rows; (16, 0)
    where all have."""
    first, past = np.float32(TILE), np.float32(0.0)
    for pair in range(TILE // 2):
        begin, bits = np.uint64(half * HALF_PIXELS + pair * 2 * HALF_WIDTH), np.int32(-1)
        for p in range(np.uint64(2 * HALF_WIDTH)):
            bits &= np.float32(s[begin + p]).view(np.int32)
        if bits >= 0:  # not all sign bits are set
            first, past = min(first, np.float32(2 * pair)), np.float32(2 * pair + 2)
    return first, past


@part_jit
def _set_coordinates(s):
    """Write the centers of a tile's pixels, relative to its corner."""
    for p in range(np.uint64(PIXELS)):
        half, within = np.int64(p) // HALF_PIXELS, np.int64(p) % HALF_PIXELS
        s[X + p] = np.float32(half * HALF_WIDTH + within % HALF_WIDTH) + np.float32(0.5)
        s[Y + p] = np.float32(within // HALF_WIDTH) + np.float32(0.5)


@part_jit
def _pixel_range(pair_rows, j, half):
    """Where the pixels of a half that pair j may reach begin and end in the tile's flat array."""
    base = half * HALF_PIXELS
    first, past = base + pair_rows[j, 2 * half] * HALF_WIDTH, base + pair_rows[j, 2 * half + 1] * HALF_WIDTH
    return np.uint64(first), np.uint64(past)


@inline_jit
def _falloff(first, past, q, batch, s):
    """Write opacity · exp(power) of splat q of a batch to s[ALPHA]. A loop of its own: together with blending, it needs
    more registers than AVX2 has."""
    mean_x, mean_y, shear = batch[AT_MEAN_X + q], batch[AT_MEAN_Y + q], batch[AT_SHEAR + q]
    qx = np.float32(-0.5) * LOG2E * batch[AT_PRECISION_X + q]
    qy = np.float32(-0.5) * LOG2E * batch[AT_PRECISION_Y + q]
    opacity = batch[AT_OPACITY + q]
    for p in range(first, past):
        dy = s[Y + p] - mean_y
        dx = s[X + p] - mean_x - shear * dy
        power = qx * dx * dx + qy * dy * dy
        s[ALPHA + p] = opacity * _exp2(power)


@inline_jit
def _blend_pair(first, past, q, order, batch, s):
    """Blend splat q of a batch over the pixels from `first` to `past`; order: its place in the tile's list, from 1."""
    _falloff(first, past, q, batch, s)
    red, green, blue = batch[AT_RED + q], batch[AT_GREEN + q], batch[AT_BLUE + q]
    bits = np.float32(order).view(np.int32)
    for p in range(first, past):
        a = min(MAX_ALPHA, s[ALPHA + p])
        a = a if a >= MIN_ALPHA else np.float32(0.0)
        t = s[p]
        after = t * (np.float32(1.0) - a)
        continues = after > MIN_TRANSMITTANCE
        weight = a * t if continues else np.float32(0.0)
        s[p] = after if continues else -abs(t)
        s[SUM_RED + p] += weight * red
        s[SUM_GREEN + p] += weight * green
        s[SUM_BLUE + p] += weight * blue
        # Positive floats order like their bits; of integers LLVM takes the maximum without a conditional store.
        reached = bits if weight > np.float32(0.0) else np.int32(0)
        s[LAST + p] = np.int32(max(np.float32(s[LAST + p]).view(np.int32), reached)).view(np.float32)


@part_jit
def _begin_tile(s, tile_rows, tile):
    """Nothing in front of the pixels of a tile's needed rows; those of the others have stopped."""
    for p in range(np.uint64(PIXELS)):
        s[p] = np.float32(1.0)
        s[SUM_RED + p] = s[SUM_GREEN + p] = s[SUM_BLUE + p] = s[LAST + p] = np.float32(0.0)
    for half in range(2):
        first, past = _pixel_range(tile_rows, tile, half)
        begin = np.uint64(half * HALF_PIXELS)
        for p in range(begin, first):
            s[p] = np.float32(-1.0)
        for p in range(past, begin + np.uint64(HALF_PIXELS)):
            s[p] = np.float32(-1.0)


@parallel(lambda tiles, *_: len(tiles))
@jit
def blend_forward(first_tile, past_tile, tiles, tiles_x, tile_rows, lists, projection, background, blended):
    """Render the listed tiles to `blended`; the tuples are those of `layout.py`.

    tiles (T,) int32 tile numbers, with `tiles_x` tiles a row; tile_rows (tiles, 4): their rows that are needed, see
    `find_needed_rows`; pixels of the others are undefined. background (3,): composited behind the splats.
    """
    start, pair_splat, projected, extent_y = lists.start, lists.pair_splat, projection.columns, projection.extent_y
    image, transmittance, last, pair_rows = blended.image, blended.transmittance, blended.last, blended.pair_rows
    height, width = last.shape
    s, batch = np.empty(STATE_SIZE, np.float32), np.empty(BATCH_SIZE, np.float32)
    _set_coordinates(s)
    for k in range(first_tile, past_tile):
        tile = tiles[k]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        _begin_tile(s, tile_rows, np.uint64(tile))
        begin, end = start[tile], start[tile + 1]
        for batch_begin in range(begin, end, BATCH_PAIRS):
            low, high = _rows_alive(s, 0)
            low_right, high_right = _rows_alive(s, 1)
            if low >= high and low_right >= high_right:
                break
            count = min(BATCH_PAIRS, end - batch_begin)
            _copy_batch(pair_splat, batch_begin, count, projected, np.float32(left), np.float32(top), batch)
            for q in range(np.uint64(count)):
                batch[AT_EXTENT_Y + q] = extent_y[np.uint64(pair_splat[np.uint64(batch_begin) + q])]
            _find_rows(count, batch)
            for q in range(np.uint64(count)):
                if q > 0 and q % np.uint64(PAIRS_PER_ALIVE_CHECK) == 0:
                    low, high = _rows_alive(s, 0)
                    low_right, high_right = _rows_alive(s, 1)
                j = np.uint64(batch_begin) + q
                pair_rows[j, 0], pair_rows[j, 1] = max(low, batch[AT_FIRST + q]), min(high, batch[AT_PAST + q])
                pair_rows[j, 2] = max(low_right, batch[AT_FIRST_RIGHT + q])
                pair_rows[j, 3] = min(high_right, batch[AT_PAST_RIGHT + q])
                for half in range(2):
                    first, past = _pixel_range(pair_rows, j, half)
                    if past > first:
                        _blend_pair(first, past, q, np.float32(np.int64(j) - begin + 1), batch, s)
        for half in range(2):
            for row in range(min(TILE, height - top)):
                first, x0, y = (
                    np.uint64(half * HALF_PIXELS + row * HALF_WIDTH),
                    left + half * HALF_WIDTH,
                    np.uint64(top + row),
                )
                for column in range(np.uint64(max(0, min(HALF_WIDTH, width - x0)))):
                    p, x = first + column, np.uint64(x0) + column
                    t = abs(s[p])
                    image[0, y, x] = s[SUM_RED + p] + t * background[0]
                    image[1, y, x] = s[SUM_GREEN + p] + t * background[1]
                    image[2, y, x] = s[SUM_BLUE + p] + t * background[2]
                    transmittance[y, x] = t
                    last[y, x] = np.int32(s[LAST + p])


@part_jit
def _find_wanted_rows(first, past, pair_splat, pair_rows, wanted, found):
    """Which rows of each half of a tile the wanted ones of its pairs reach, to found[0]; laid out like pair_rows."""
    found[0, 0] = found[0, 2] = TILE
    found[0, 1] = found[0, 3] = 0
    for j in range(np.uint64(first), np.uint64(past)):
        if wanted[pair_splat[j]]:
            for half in range(2):
                low, high = pair_rows[j, 2 * half], pair_rows[j, 2 * half + 1]
                if low < high:
                    found[0, 2 * half] = min(found[0, 2 * half], low)
                    found[0, 2 * half + 1] = max(found[0, 2 * half + 1], high)
            if found[0, 1] - found[0, 0] == TILE and found[0, 3] - found[0, 2] == TILE:
                break


@inline_jit
def _unblend_pair(first, past, q, order, batch, s):
    """Take splat q of a batch off the pixels again: its weight and the gradient of its power, to s[WEIGHT] and
    s[V_POWER]."""
    _falloff(first, past, q, batch, s)
    red, green, blue = batch[AT_RED + q], batch[AT_GREEN + q], batch[AT_BLUE + q]
    for p in range(first, past):
        raw = s[ALPHA + p]
        a = min(MAX_ALPHA, raw)
        a = a if (a >= MIN_ALPHA) & (order <= s[LAST + p]) else np.float32(0.0)
        ra = np.float32(1.0) / (np.float32(1.0) - a)
        t = s[p] * ra
        weight = a * t
        along = red * s[V_RED + p] + green * s[V_GREEN + p] + blue * s[V_BLUE + p]
        v_a = t * along - ra * s[BEHIND + p]
        s[p] = t
        s[BEHIND + p] += weight * along
        s[WEIGHT + p] = weight
        # d alpha / d power through the clamp is zero; `a` zeroes pixels that this splat does not reach.
        s[V_POWER + p] = a * v_a if raw < MAX_ALPHA else np.float32(0.0)


@inline_jit
def _sum_falloff_gradient(first, past, q, batch, s, sums):
    """Add the sums over pixels of the power's gradient times 1, dx, dy, dx², dx·dy and dy² to sums[:6]."""
    mean_x, mean_y, shear = batch[AT_MEAN_X + q], batch[AT_MEAN_Y + q], batch[AT_SHEAR + q]
    g0 = gx = gy = gxx = gxy = gyy = np.float32(0.0)
    for p in range(first, past):
        dy = s[Y + p] - mean_y
        dx = s[X + p] - mean_x - shear * dy
        g = s[V_POWER + p]
        g_dx, g_dy = g * dx, g * dy
        g0 += g
        gx += g_dx
        gy += g_dy
        gxx += g_dx * dx
        gxy += g_dx * dy
        gyy += g_dy * dy
    sums[0] += g0
    sums[1] += gx
    sums[2] += gy
    sums[3] += gxx
    sums[4] += gxy
    sums[5] += gyy


@inline_jit
def _sum_color_gradient(first, past, s, sums):
    """Add the sums over pixels of the weight times the image's gradient to sums[6:]; apart from the other six, because
    nine sums need more registers than AVX2 has."""
    red = green = blue = np.float32(0.0)
    for p in range(first, past):
        weight = s[WEIGHT + p]
        red += weight * s[V_RED + p]
        green += weight * s[V_GREEN + p]
        blue += weight * s[V_BLUE + p]
    sums[6] += red
    sums[7] += green
    sums[8] += blue


@parallel(lambda tiles, *_: len(tiles))
@jit
def blend_backward(
    first_tile, past_tile, tiles, tiles_x, lists, blended, wanted, projected, background, v_image, v_transmittance,
    pair_gradients,
):  # fmt: skip
    """Write the gradient of every wanted (tile, splat) pair of the listed tiles to pair_gradients (P, PROJECTED).

    wanted (N,) bool: splats whose gradient is needed. projected (N, PROJECTED): the columns of the projection. v_image
    (3, H, W), v_transmittance (H, W): gradients of the image over the background and of the transmittance. Each pair
    has a row of its own, so that the sum over a splat's pairs has one order whatever the threads do.
    """
    start, pair_splat, grads = lists.start, lists.pair_splat, pair_gradients
    transmittance, last, pair_rows = blended.transmittance, blended.last, blended.pair_rows
    height, width = last.shape
    s, batch, sums = np.empty(STATE_SIZE, np.float32), np.empty(BATCH_SIZE, np.float32), np.empty(PROJECTED, np.float32)
    rows = np.empty((1, 4), np.uint8)
    _set_coordinates(s)
    for k in range(first_tile, past_tile):
        tile = tiles[k]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        if left + TILE > width or top + TILE > height:  # pixels outside the image
            for p in range(np.uint64(PIXELS)):
                s[p] = np.float32(1.0)
                s[BEHIND + p] = s[V_RED + p] = s[V_GREEN + p] = s[V_BLUE + p] = s[LAST + p] = np.float32(0.0)
        deepest = np.int64(0)
        for half in range(2):
            for row in range(min(TILE, height - top)):
                first, x0, y = (
                    np.uint64(half * HALF_PIXELS + row * HALF_WIDTH),
                    left + half * HALF_WIDTH,
                    np.uint64(top + row),
                )
                for column in range(np.uint64(max(0, min(HALF_WIDTH, width - x0)))):
                    p, x = first + column, np.uint64(x0) + column
                    t = transmittance[y, x]
                    s[p] = t
                    vr, vg, vb = v_image[0, y, x], v_image[1, y, x], v_image[2, y, x]
                    behind = background[0] * vr + background[1] * vg + background[2] * vb
                    s[BEHIND + p] = t * (behind + v_transmittance[y, x])
                    s[V_RED + p], s[V_GREEN + p], s[V_BLUE + p] = vr, vg, vb
                    s[LAST + p] = np.float32(last[y, x])
                    deepest = max(deepest, np.int64(last[y, x]))
        begin = start[tile]
        grads[begin + deepest : start[tile + 1], :] = np.float32(0.0)
        nearest = begin  # nothing in front of the first wanted pair needs to be walked
        while nearest < begin + deepest and not wanted[pair_splat[nearest]]:
            nearest += 1
        _find_wanted_rows(nearest, begin + deepest, pair_splat, pair_rows, wanted, rows)
        batch_end = begin + deepest
        while batch_end > nearest:
            batch_begin = max(nearest, batch_end - BATCH_PAIRS)
            count = batch_end - batch_begin
            _copy_batch(pair_splat, batch_begin, count, projected, np.float32(left), np.float32(top), batch)
            for n in range(count):
                q = np.uint64(count - 1 - n)
                j = np.uint64(batch_begin) + q
                order, is_wanted = np.float32(np.int64(j) - begin + 1), wanted[pair_splat[j]]
                sums[:] = np.float32(0.0)
                for half in range(2):
                    first, past = _pixel_range(pair_rows, j, half)
                    if not is_wanted:  # a frozen one is only stepped through, where a wanted one reaches
                        low, high = _pixel_range(rows, 0, half)
                        first, past = max(first, low), min(past, high)
                    if past <= first:
                        continue
                    _unblend_pair(first, past, q, order, batch, s)
                    if is_wanted:
                        _sum_falloff_gradient(first, past, q, batch, s, sums)
                        _sum_color_gradient(first, past, s, sums)
                if is_wanted:
                    precision_x, precision_y, shear = (
                        batch[AT_PRECISION_X + q],
                        batch[AT_PRECISION_Y + q],
                        batch[AT_SHEAR + q],
                    )
                    grads[j, MEAN_X] = precision_x * sums[1]
                    grads[j, MEAN_Y] = precision_y * sums[2] - shear * precision_x * sums[1]
                    grads[j, PRECISION_X] = np.float32(-0.5) * sums[3]
                    grads[j, SHEAR] = precision_x * sums[4]
                    grads[j, PRECISION_Y] = np.float32(-0.5) * sums[5]
                    grads[j, OPACITY] = sums[0] / batch[AT_OPACITY + q]
                    grads[j, RED], grads[j, GREEN], grads[j, BLUE] = sums[6], sums[7], sums[8]
            batch_end = batch_begin
