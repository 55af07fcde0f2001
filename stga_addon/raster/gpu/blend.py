"""Alpha blending of the splats of each 16×16 tile; the counterpart of `cpu/blend.py`.

Forward: a thread a pixel, a block of 256 threads a tile, so all of a block read the same splat at once (one
broadcast from the cache). Backward: a warp half a tile, four pixels a lane. The gradient of a (tile, splat) pair is
summed over the warp's registers, and each half has a row of its own to write it to; the rows of a splat are summed
later, in order. So no two threads write one place and no sum depends on chance.

On Warp's CPU device, where threads run one after the other, a warp is a single lane: `_warp_sum` and its like return
their argument, every lane counts as the leading one, and rows are added to, in the order of lanes.
"""

import warp as wp

from ..cpu import blend as cpu
from ..cpu import layout
from ..cpu.layout import BLUE, GREEN, MEAN_X, MEAN_Y, OPACITY, PRECISION_X, PRECISION_Y, RED, SHEAR
from .project import Projected
from .tiles import UNMARKED

wp.set_module_options({"enable_backward": False})

TILE, PIXELS = wp.constant(layout.TILE), wp.constant(layout.PIXELS)
MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE = (
    wp.constant(float(c)) for c in (cpu.MAX_ALPHA, cpu.MIN_ALPHA, cpu.MIN_TRANSMITTANCE)
)
WARP_LANES = wp.constant(32)
WARPS_PER_TILE = wp.constant(2)
"""Warps a tile has in the backward, and rows a pair: more warps fill a GPU better, fewer add up less."""
PIXELS_PER_LANE = layout.PIXELS // (32 * 2)

LaneFloats = wp.types.vector(length=PIXELS_PER_LANE, dtype=wp.float32)
"""A value of each of a lane's pixels."""
LaneInts = wp.types.vector(length=PIXELS_PER_LANE, dtype=wp.int32)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, offset);
#endif
    return value;
""")
def _warp_sum(value: wp.float32) -> wp.float32:
    """The sum over a warp, the same in all lanes; all must call."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset >>= 1)
        value = max(value, __shfl_xor_sync(0xffffffffu, value, offset));
#endif
    return value;
""")
def _warp_max(value: wp.int32) -> wp.int32:
    """The largest value of a warp, the same in all lanes; all must call."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return (threadIdx.x & 31) == 0;
#else
    return true;
#endif
""")
def _is_warp_leader() -> wp.bool:
    """Whether this lane writes for its warp."""
    ...


@wp.func
def _power(row: Projected, x: float, y: float) -> float:
    """Logarithm of a splat's density at an offset from its center: squares, whose sign rounding cannot turn."""
    dx = x - row[SHEAR] * y
    return -0.5 * (row[PRECISION_X] * dx * dx + row[PRECISION_Y] * y * y)


@wp.kernel
def blend_forward(
    tiles_x: wp.int32,
    rendered: wp.array[wp.uint8],
    first: wp.array[wp.int32],
    past: wp.array[wp.int32],
    pair_splat: wp.array[wp.int32],
    projected: wp.array[Projected],
    background: wp.vec3,
    image: wp.array3d[wp.float32],
    transmittance: wp.array2d[wp.float32],
    last: wp.array2d[wp.int32],
):
    """As the CPU's, for the rendered tiles; launched over all tiles' pixels."""
    n = wp.tid()
    tile, p = n // PIXELS, n % PIXELS
    left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    x, y = left + p % TILE, top + p // TILE
    if rendered[tile] == UNMARKED or y >= last.shape[0] or x >= last.shape[1]:
        return
    px, py = float(p % TILE) + 0.5, float(p // TILE) + 0.5
    color, t, deepest = wp.vec3(), float(1.0), int(0)
    begin = first[tile]
    for j in range(begin, past[tile]):
        row = projected[pair_splat[j]]
        density = wp.exp(_power(row, px - (row[MEAN_X] - float(left)), py - (row[MEAN_Y] - float(top))))
        a = wp.min(MAX_ALPHA, row[OPACITY] * density)
        if a < MIN_ALPHA:
            continue
        after = t * (1.0 - a)
        if after <= MIN_TRANSMITTANCE:
            break
        color += a * t * wp.vec3(row[RED], row[GREEN], row[BLUE])
        t = after
        deepest = j - begin + 1
    color += t * background
    image[0, y, x] = color[0]
    image[1, y, x] = color[1]
    image[2, y, x] = color[2]
    transmittance[y, x] = t
    last[y, x] = deepest


@wp.kernel
def blend_backward(
    tiles_x: wp.int32,
    touched: wp.array[wp.uint8],
    first: wp.array[wp.int32],
    pair_splat: wp.array[wp.int32],
    pair_slot: wp.array[wp.int32],
    wanted: wp.array[wp.uint8],
    projected: wp.array[Projected],
    background: wp.vec3,
    transmittance: wp.array2d[wp.float32],
    last: wp.array2d[wp.int32],
    v_image: wp.array3d[wp.float32],
    v_transmittance: wp.array2d[wp.float32],
    rows: wp.array[Projected],
):
    """Add the gradient of every wanted pair of the touched tiles to its rows, slot · WARPS_PER_TILE and on, which are
    zero.

    Launched over WARPS_PER_TILE · WARP_LANES threads a tile. v_transmittance may have no rows, which means zero.
    """
    n = wp.tid()
    lane, part = n % WARP_LANES, (n // WARP_LANES) % WARPS_PER_TILE
    tile = n // (WARP_LANES * WARPS_PER_TILE)
    if touched[tile] == UNMARKED:
        return
    left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    t, behind = LaneFloats(), LaneFloats()
    v_red, v_green, v_blue = LaneFloats(), LaneFloats(), LaneFloats()
    until = LaneInts()
    deepest = int(0)
    base = part * (PIXELS // WARPS_PER_TILE) + lane  # neighboring lanes have neighboring pixels
    for k in range(wp.static(PIXELS_PER_LANE)):
        p = base + k * WARP_LANES
        column, line = left + p % TILE, top + p // TILE
        if line < last.shape[0] and column < last.shape[1]:
            t[k] = transmittance[line, column]
            v = wp.vec3(v_image[0, line, column], v_image[1, line, column], v_image[2, line, column])
            v_red[k] = v[0]
            v_green[k] = v[1]
            v_blue[k] = v[2]
            through = wp.dot(background, v)
            if v_transmittance.shape[0] > 0:
                through += v_transmittance[line, column]
            behind[k] = t[k] * through
            until[k] = last[line, column]
            deepest = wp.max(deepest, until[k])
    deepest = _warp_max(deepest)
    begin = first[tile]
    nearest = begin  # nothing in front of the first wanted pair needs to be walked
    while nearest < begin + deepest and wanted[pair_splat[nearest]] == UNMARKED:
        nearest += 1
    for back in range(begin + deepest - nearest):
        j = begin + deepest - 1 - back
        i = pair_splat[j]
        row = projected[i]
        mean_x, mean_y = row[MEAN_X] - float(left), row[MEAN_Y] - float(top)
        red, green, blue = row[RED], row[GREEN], row[BLUE]
        g0, gx, gy = float(0.0), float(0.0), float(0.0)
        gxx, gxy, gyy = float(0.0), float(0.0), float(0.0)
        g_red, g_green, g_blue = float(0.0), float(0.0), float(0.0)
        counts = int(0)
        for k in range(wp.static(PIXELS_PER_LANE)):
            p = base + k * WARP_LANES
            y = float(p // TILE) + 0.5 - mean_y
            x = float(p % TILE) + 0.5 - mean_x
            raw = row[OPACITY] * wp.exp(_power(row, x, y))
            a = wp.min(MAX_ALPHA, raw)
            if a >= MIN_ALPHA and j - begin < until[k]:
                ra = 1.0 / (1.0 - a)
                before = t[k] * ra
                weight = a * before
                along = red * v_red[k] + green * v_green[k] + blue * v_blue[k]
                v_a = before * along - ra * behind[k]
                t[k] = before
                behind[k] = behind[k] + weight * along
                g = wp.where(raw < MAX_ALPHA, v_a * raw, 0.0)
                dx = x - row[SHEAR] * y
                g0 += g
                gx += g * dx
                gy += g * y
                gxx += g * dx * dx
                gxy += g * dx * y
                gyy += g * y * y
                g_red += weight * v_red[k]
                g_green += weight * v_green[k]
                g_blue += weight * v_blue[k]
                counts = int(1)
        if wanted[i] == UNMARKED:
            continue
        if _warp_max(counts) == 0:
            continue
        total = Projected(g0, gx, gy, gxx, gxy, gyy, g_red, g_green, g_blue)
        for c in range(wp.static(layout.PROJECTED)):
            total[c] = _warp_sum(total[c])
        if _is_warp_leader():
            by_x = row[PRECISION_X] * total[1]
            at = pair_slot[j] * WARPS_PER_TILE + part
            rows[at] = rows[at] + Projected(
                by_x, row[PRECISION_Y] * total[2] - row[SHEAR] * by_x, -0.5 * total[3], row[PRECISION_X] * total[4],
                -0.5 * total[5], total[0] / row[OPACITY], total[6], total[7], total[8],
            )  # fmt: skip
