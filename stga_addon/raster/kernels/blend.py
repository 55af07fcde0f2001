"""Alpha blending of the splats of each 16×16 tile, forward and backward.

A pixel takes splats front to back and stops before the one whose transmittance would be ≤ 1e-4. The forward
stores each pixel's last contributing pair and the backward obeys it, so transmittance never underflows behind
many opaque splats.
"""

import numpy as np

from . import inline_jit, jit
from .threads import parallel

TILE = 16
PIXELS = TILE * TILE
ALPHA_MAX = np.float32(0.999)
ALPHA_MIN = np.float32(1 / 255)
STOP = np.float32(1e-4)
LOG2E = np.float32(1.4426950408889634)

# Columns of the projected splat (see project.py) and of the gradient of one (tile, splat) pair.
# Its density is 2^power, power = −½·log2(e)·(PRECISION_X·(dx − SHEAR·dy)² + PRECISION_Y·dy²). The usual three entries
# of the inverse covariance lose the small one of a long needle, and with it the sign of the power; squares cannot.
MEAN_X, MEAN_Y, PRECISION_X, SHEAR, PRECISION_Y, OPACITY, RED, GREEN, BLUE = range(9)
PROJECTED = 9

# Where a pixel's values lie in the tile's flat array. Unsigned, because a signed index that may be negative wraps
# around in Python, and the test for it keeps LLVM from vectorising (12 times slower).
ALIVE, SUM_RED, SUM_GREEN, SUM_BLUE, LAST, X, Y, WEIGHT, PULL = (np.uint64(n * PIXELS) for n in range(1, 10))
BEHIND, V_RED, V_GREEN, V_BLUE = ALIVE, SUM_RED, SUM_GREEN, SUM_BLUE
STATE = 10 * PIXELS


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


@parallel(lambda tiles, *_: len(tiles))
@jit
def blend_forward(
    first_tile, past_tile,
    tiles, tiles_x, start, pair_splat, pair_rows, projected, background, image, transmittance, last,
):  # fmt: skip
    """Render the listed tiles.

    tiles (T,) int32 tile ids, row-major with `tiles_x` tiles a row; start (tiles + 1,) int32 into the pair
    list; pair_splat (P,) int32 and pair_rows (P, 2) uint8, as in `bins.py`, front to back in each tile; projected (N, 9).
    background (3,): composited behind the splats. Writes image (3, H, W), transmittance (H, W) (1 − alpha, kept
    because the backward needs its small values exactly), and last (H, W) int32: one past the last contributing pair
    of the tile, counted from the tile's start.
    """
    height, width = last.shape
    s = np.empty(STATE, np.float32)
    for k in range(first_tile, past_tile):
        tile = tiles[k]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        x0, y0 = np.float32(left), np.float32(top)
        s[:] = np.float32(0.0)
        for p in range(np.uint64(PIXELS)):
            s[p] = np.float32(1.0)
            s[ALIVE + p] = np.float32(1.0)
            s[X + p] = np.float32(np.int64(p) % TILE) + np.float32(0.5)
            s[Y + p] = np.float32(np.int64(p) // TILE) + np.float32(0.5)
        begin, end = start[tile], start[tile + 1]
        for j in range(begin, end):
            if (j - begin) % 16 == 15:
                alive = np.float32(0.0)
                for p in range(np.uint64(PIXELS)):
                    alive += s[ALIVE + p]
                if alive == np.float32(0.0):
                    break
            i = pair_splat[j]
            mean_x, mean_y = projected[i, MEAN_X] - x0, projected[i, MEAN_Y] - y0
            qx = np.float32(-0.5) * LOG2E * projected[i, PRECISION_X]
            qy = np.float32(-0.5) * LOG2E * projected[i, PRECISION_Y]
            shear = projected[i, SHEAR]
            opacity = projected[i, OPACITY]
            red, green, blue = projected[i, RED], projected[i, GREEN], projected[i, BLUE]
            first, past = pair_rows[j, 0], pair_rows[j, 1]
            order = np.float32(j - begin + 1)
            for p in range(np.uint64(first * TILE), np.uint64(past * TILE)):
                dy = s[Y + p] - mean_y
                dx = s[X + p] - mean_x - shear * dy
                power = qx * dx * dx + qy * dy * dy
                a = min(ALPHA_MAX, opacity * _exp2(power))
                a = a * s[ALIVE + p] if a >= ALPHA_MIN else np.float32(0.0)
                t = s[p]
                after = t * (np.float32(1.0) - a)
                goes_on = after > STOP
                weight = a * t if goes_on else np.float32(0.0)
                s[ALIVE + p] = s[ALIVE + p] if goes_on else np.float32(0.0)
                s[p] = after if goes_on else t
                s[SUM_RED + p] += weight * red
                s[SUM_GREEN + p] += weight * green
                s[SUM_BLUE + p] += weight * blue
                s[LAST + p] = order if weight > np.float32(0.0) else s[LAST + p]
        for row in range(min(TILE, height - top)):
            for column in range(min(TILE, width - left)):
                p = np.uint64(row * TILE + column)
                image[0, top + row, left + column] = s[SUM_RED + p] + s[p] * background[0]
                image[1, top + row, left + column] = s[SUM_GREEN + p] + s[p] * background[1]
                image[2, top + row, left + column] = s[SUM_BLUE + p] + s[p] * background[2]
                transmittance[top + row, left + column] = s[p]
                last[top + row, left + column] = np.int32(s[LAST + p])


@parallel(lambda tiles, *_: len(tiles))
@jit
def blend_backward(
    first_tile, past_tile,
    tiles, tiles_x, start, pair_splat, pair_rows, pair_slot, wanted, projected, background, transmittance, last,
    v_image, v_transmittance, grads,
):  # fmt: skip
    """Gradient of every wanted (tile, splat) pair of the listed tiles.

    wanted (N,) bool: splats whose gradient is needed. pair_slot (P,) int32: where a pair's gradient goes in
    grads (P, 9), with the columns of `projected`; written once each, so the sum per splat is deterministic.
    v_image (3, H, W) and v_transmittance (H, W): gradients of the composited image and of the transmittance.
    """
    height, width = last.shape
    s = np.empty(STATE, np.float32)
    for k in range(first_tile, past_tile):
        tile = tiles[k]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        x0, y0 = np.float32(left), np.float32(top)
        s[:] = np.float32(0.0)
        deepest = 0
        for p in range(np.uint64(PIXELS)):
            s[p] = np.float32(1.0)
            s[X + p] = np.float32(np.int64(p) % TILE) + np.float32(0.5)
            s[Y + p] = np.float32(np.int64(p) // TILE) + np.float32(0.5)
        for row in range(min(TILE, height - top)):
            for column in range(min(TILE, width - left)):
                p, y, x = np.uint64(row * TILE + column), top + row, left + column
                t = transmittance[y, x]
                s[p] = t
                vr, vg, vb = v_image[0, y, x], v_image[1, y, x], v_image[2, y, x]
                behind = background[0] * vr + background[1] * vg + background[2] * vb
                s[BEHIND + p] = t * (behind + v_transmittance[y, x])
                s[V_RED + p], s[V_GREEN + p], s[V_BLUE + p] = vr, vg, vb
                s[LAST + p] = np.float32(last[y, x])
                deepest = max(deepest, last[y, x])
        begin = start[tile]
        for j in range(begin + deepest, start[tile + 1]):
            slot = pair_slot[j]
            for c in range(PROJECTED):
                grads[slot, c] = np.float32(0.0)
        nearest = begin  # nothing in front of the first wanted pair needs to be walked
        while nearest < begin + deepest and not wanted[pair_splat[nearest]]:
            nearest += 1
        for j in range(begin + deepest - 1, nearest - 1, -1):
            i = pair_splat[j]
            mean_x, mean_y = projected[i, MEAN_X] - x0, projected[i, MEAN_Y] - y0
            precision_x, shear, precision_y = projected[i, PRECISION_X], projected[i, SHEAR], projected[i, PRECISION_Y]
            qx, qy = np.float32(-0.5) * LOG2E * precision_x, np.float32(-0.5) * LOG2E * precision_y
            opacity = projected[i, OPACITY]
            red, green, blue = projected[i, RED], projected[i, GREEN], projected[i, BLUE]
            first, past = pair_rows[j, 0], pair_rows[j, 1]
            order = np.float32(j - begin + 1)
            for p in range(np.uint64(first * TILE), np.uint64(past * TILE)):
                dy = s[Y + p] - mean_y
                dx = s[X + p] - mean_x - shear * dy
                power = qx * dx * dx + qy * dy * dy
                raw = opacity * _exp2(power)
                a = min(ALPHA_MAX, raw)
                a = a if (a >= ALPHA_MIN) and (order <= s[LAST + p]) else np.float32(0.0)
                ra = np.float32(1.0) / (np.float32(1.0) - a)
                t = s[p] * ra
                weight = a * t
                along = red * s[V_RED + p] + green * s[V_GREEN + p] + blue * s[V_BLUE + p]
                v_a = t * along - ra * s[BEHIND + p]
                s[p] = t
                s[BEHIND + p] += weight * along
                s[WEIGHT + p] = weight
                # d alpha / d power through the clamp is zero; `a` zeroes pixels that this splat does not reach.
                s[PULL + p] = a * v_a if raw < ALPHA_MAX else np.float32(0.0)
            if not wanted[i]:
                continue  # a frozen splat only has to be stepped through, in the very same arithmetic
            g0 = gx = gy = gxx = gxy = gyy = gr = gg = gb = np.float32(0.0)
            for p in range(np.uint64(first * TILE), np.uint64(past * TILE)):
                dy = s[Y + p] - mean_y
                dx = s[X + p] - mean_x - shear * dy
                g, weight = s[PULL + p], s[WEIGHT + p]
                g0 += g
                gx += g * dx
                gy += g * dy
                gxx += g * dx * dx
                gxy += g * dx * dy
                gyy += g * dy * dy
                gr += weight * s[V_RED + p]
                gg += weight * s[V_GREEN + p]
                gb += weight * s[V_BLUE + p]
            slot = pair_slot[j]
            grads[slot, MEAN_X] = precision_x * gx
            grads[slot, MEAN_Y] = precision_y * gy - shear * precision_x * gx
            grads[slot, PRECISION_X] = np.float32(-0.5) * gxx
            grads[slot, SHEAR] = precision_x * gxy
            grads[slot, PRECISION_Y] = np.float32(-0.5) * gyy
            grads[slot, OPACITY] = g0 / opacity
            grads[slot, RED] = gr
            grads[slot, GREEN] = gg
            grads[slot, BLUE] = gb
