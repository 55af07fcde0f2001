"""Embedding, projection and color of every splat in one pass, forward and backward.

The face frames arrive already in camera space (composed in float64 by the caller), so a head far
from the world's origin loses nothing to float32, and embedded and world-space splats take the same
path. The arithmetic is in `splat_block`; here, what is scattered in memory is copied there and
back.
"""

import math

import numpy as np

from ...avatar.offsets import TARGETS
from . import inline_jit, part_jit
from . import splat_block as block
from .elementary import prefetch
from .layout import (
    BLUE,
    GREEN,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    PRECISION_X,
    PRECISION_Y,
    PROJECTED,
    RED,
    SHEAR,
    TILE,
)
from .optimizer import adam_block, correct_bias
from .splat_block import BLOCK_SPLATS, HALF, ONE, ZERO
from .threads import call_helpers, parallel, pieces

COLUMN = np.uint64(BLOCK_SPLATS)
"""Values from one column of a block to the next. Unsigned, as in `blend`."""
PAIRS_AHEAD = 64
"""Pairs ahead of the current one whose gradients are prefetched."""
SPLATS_PER_PIECE = 4 * BLOCK_SPLATS
"""Splats that a thread takes over at a time."""


@parallel(lambda origin, *_: len(origin), piece=1024)
def compose_frames(work, origin, rotation, scale, turn, shift, camera_origin, camera_matrix):
    """Face frames as a camera sees them: camera_matrix = turn @ rotation · scale, camera_origin =
    turn @ origin + shift.

    origin (F, 3), rotation (F, 3, 3), scale (F,), turn (3, 3) and shift (3,) float64, so that
    distance from the origin costs no precision. Writes camera_origin (F, 3) and camera_matrix (F,
    3, 3) float32.
    """
    call_helpers(work)
    for begin, end in pieces(work):
        for f in range(begin, end):
            for r in range(3):
                t0 = turn[r, 0]
                t1 = turn[r, 1]
                t2 = turn[r, 2]
                camera_origin[f, r] = (
                    t0 * origin[f, 0] + t1 * origin[f, 1] + t2 * origin[f, 2] + shift[r]
                )
                for c in range(3):
                    along = t0 * rotation[f, 0, c] + t1 * rotation[f, 1, c] + t2 * rotation[f, 2, c]
                    camera_matrix[f, r, c] = scale[f] * along


POSITION, SCALE, COLOR = range(len(TARGETS))


@parallel(lambda coefficients, *_: len(coefficients), piece=1024)
def move_frames(work, coefficients, signal, target, rotation, unit, moved):
    """Change face frames by a driven offset (`avatar.offsets`): coefficients (F, 3, 3) and signal
    (F, 3) float32; target: POSITION, SCALE or COLOR.

    rotation (F, 3, 3) and unit (F,) float64 are those of the frames before any change; moved: their
    origin (F, 3) and scale (F,) float64, and color (F, 3) float32, of which one is changed.
    """
    origin, scale, color = moved
    call_helpers(work)
    for begin, end in pieces(work):
        for f in range(begin, end):
            s0 = signal[f, 0]
            s1 = signal[f, 1]
            s2 = signal[f, 2]
            m = coefficients[f]
            change0 = s0 * m[0, 0] + s1 * m[1, 0] + s2 * m[2, 0]
            change1 = s0 * m[0, 1] + s1 * m[1, 1] + s2 * m[2, 1]
            change2 = s0 * m[0, 2] + s1 * m[1, 2] + s2 * m[2, 2]
            if target == POSITION:
                for c in range(3):
                    turned = (
                        rotation[f, c, 0] * change0
                        + rotation[f, c, 1] * change1
                        + rotation[f, c, 2] * change2
                    )
                    origin[f, c] += unit[f] * turned
            elif target == SCALE:
                scale[f] *= math.exp(np.float64(change0))
            elif target == COLOR:
                color[f, 0] += change0
                color[f, 1] += change1
                color[f, 2] += change2


@parallel(lambda rows, *_: len(rows), piece=4096)
def count_marked(work, rows, xyz, face, frames, mask, inside, marked):
    """Add 1 to inside (N,) int32 of the listed splats (M,) int32 whose centers xyz (N, 3) lie in a
    camera's image, and to marked (N,) int32 where the mask (H, W) bool holds there; frames: a
    CameraFrames of the mask's size."""
    height, width = mask.shape
    fl_x, fl_y, cx, cy = frames.intrinsics
    call_helpers(work)
    for begin, end in pieces(work):
        for n in range(begin, end):
            i = rows[n]
            m = frames.matrix[face[i]]
            t = frames.origin[face[i]]
            z = m[2, 0] * xyz[i, 0] + m[2, 1] * xyz[i, 1] + m[2, 2] * xyz[i, 2] + t[2]
            if z > block.NEAR_M:
                x = m[0, 0] * xyz[i, 0] + m[0, 1] * xyz[i, 1] + m[0, 2] * xyz[i, 2] + t[0]
                y = m[1, 0] * xyz[i, 0] + m[1, 1] * xyz[i, 1] + m[1, 2] * xyz[i, 2] + t[1]
                column = fl_x * x / z + cx
                row = fl_y * y / z + cy
                if 0 <= column < width and 0 <= row < height:
                    inside[i] += 1
                    if mask[int(row), int(column)]:
                        marked[i] += 1


@part_jit
def _load(rows, splats, face, frames, b):
    """Copy the listed splats (at most BLOCK_SPLATS) and their frames to the block `b`."""
    xyz = splats.xyz
    rotation = splats.rotation
    log_scale = splats.log_scale
    opacity = splats.opacity
    origin = frames.origin
    m = frames.matrix
    for q in range(np.uint64(len(rows))):
        i = np.uint64(rows[q])
        f = np.uint64(face[i])
        b[block.M00 + q] = m[f, 0, 0]
        b[block.M01 + q] = m[f, 0, 1]
        b[block.M02 + q] = m[f, 0, 2]
        b[block.M10 + q] = m[f, 1, 0]
        b[block.M11 + q] = m[f, 1, 1]
        b[block.M12 + q] = m[f, 1, 2]
        b[block.M20 + q] = m[f, 2, 0]
        b[block.M21 + q] = m[f, 2, 1]
        b[block.M22 + q] = m[f, 2, 2]
        b[block.ORIGIN_X + q] = origin[f, 0]
        b[block.ORIGIN_Y + q] = origin[f, 1]
        b[block.ORIGIN_Z + q] = origin[f, 2]
        b[block.LOCAL_X + q] = xyz[i, 0]
        b[block.LOCAL_Y + q] = xyz[i, 1]
        b[block.LOCAL_Z + q] = xyz[i, 2]
        b[block.RAW_0 + q] = rotation[i, 0]
        b[block.RAW_1 + q] = rotation[i, 1]
        b[block.RAW_2 + q] = rotation[i, 2]
        b[block.RAW_3 + q] = rotation[i, 3]
        b[block.LOG_0 + q] = log_scale[i, 0]
        b[block.LOG_1 + q] = log_scale[i, 1]
        b[block.LOG_2 + q] = log_scale[i, 2]
        b[block.LOGIT + q] = opacity[i]


@part_jit
def _color(b, q, i, coefficients, sh):
    """Red, green and blue of splat i, which stands at q in the block; negative, infinite and NaN as
    they come."""
    red = green = blue = HALF
    for k in range(coefficients):
        harmonic = b[block.B0 + k * COLUMN + q]
        red += harmonic * sh[i, k, 0]
        green += harmonic * sh[i, k, 1]
        blue += harmonic * sh[i, k, 2]
    return red, green, blue


@part_jit
def _count_rendered(covered, x0, y0, x1, y1):
    """How many tiles within bounds are rendered; covered: see `project_forward`."""
    return covered[y1, x1] - covered[y0, x1] - covered[y1, x0] + covered[y0, x0]


@part_jit
def _shrink_bounds(covered, x0, y0, x1, y1):
    """Bounds of the rendered tiles within bounds, of which there is one at least."""
    while _count_rendered(covered, x0, y0, x1, y0 + 1) == 0:
        y0 += 1
    while _count_rendered(covered, x0, y1 - 1, x1, y1) == 0:
        y1 -= 1
    while _count_rendered(covered, x0, y0, x0 + 1, y1) == 0:
        x0 += 1
    while _count_rendered(covered, x1 - 1, y0, x1, y1) == 0:
        x1 -= 1
    return x0, y0, x1, y1


@part_jit
def _tan_limits(intrinsics, size):
    """Bounds of x/z and y/z in the projection's Jacobian: the image plus 0.3 of its half field of
    view."""
    fx = intrinsics[0]
    fy = intrinsics[1]
    cx = intrinsics[2]
    cy = intrinsics[3]
    width = np.float32(size[0])
    height = np.float32(size[1])
    margin = np.float32(0.3)
    half_x = HALF * width / fx
    half_y = HALF * height / fy
    return (
        -cx / fx - margin * half_x,
        (width - cx) / fx + margin * half_x,
        -cy / fy - margin * half_y,
        (height - cy) / fy + margin * half_y,
    )


@part_jit
def _bound(b, column, q):
    """One of the block's bounds in tiles; 0 of a splat that is not visible, whose bounds may be no
    number."""
    return np.int64(b[column + q] if b[block.VISIBLE + q] > ZERO else ZERO)


@part_jit
def _list_visible(rows, covered, rect, b, visible):
    """List the places of the block's visible splats in `visible`, their bounds shrunk to the
    rendered tiles, and write `rect` of all as of splats that are not. Returns how many are visible.

    Without a branch that depends on which tiles are rendered, but at these tiles' border.
    """
    count = np.uint64(0)
    for q in range(np.uint64(len(rows))):
        i = np.uint64(rows[q])
        outside = np.int32(min(ZERO, b[block.VISIBLE + q]))
        x0 = _bound(b, block.X0, q)
        y0 = _bound(b, block.Y0, q)
        x1 = _bound(b, block.X1, q)
        y1 = _bound(b, block.Y1, q)
        found = _count_rendered(covered, x0, y0, x1, y1)
        rect[i, 0] = rect[i, 1] = rect[i, 2] = rect[i, 3] = outside
        visible[count] = q
        count += np.uint64(found > 0)
        if found > 0 and found < (x1 - x0) * (y1 - y0):
            x0, y0, x1, y1 = _shrink_bounds(covered, x0, y0, x1, y1)
            b[block.X0 + q] = x0
            b[block.Y0 + q] = y0
            b[block.X1 + q] = x1
            b[block.Y1 + q] = y1
    return count


@inline_jit
def _is_finite(color):
    red, green, blue = color
    return abs(red) < np.inf and abs(green) < np.inf and abs(blue) < np.inf


@part_jit
def _store(b, q, i, color, projection, depth_as_color):
    """Write row i of the projection from splat q of the block; a color that is no number makes the
    splat one that is not finite."""
    rect = projection.rect
    columns = projection.columns
    # Before the cut at zero, which would turn NaN and −∞ into black.
    if not _is_finite(color):
        rect[i, 0] = rect[i, 1] = rect[i, 2] = rect[i, 3] = -1
        return
    z = b[block.CAMERA_Z + q]
    if depth_as_color:
        color = (z, ZERO, ZERO)
    rect[i, 0] = np.int32(b[block.X0 + q])
    rect[i, 1] = np.int32(b[block.Y0 + q])
    rect[i, 2] = np.int32(b[block.X1 + q])
    rect[i, 3] = np.int32(b[block.Y1 + q])
    projection.depth[i] = z
    projection.extent_y[i] = b[block.EXTENT_Y + q]
    columns[i, MEAN_X] = b[block.MEAN_X + q]
    columns[i, MEAN_Y] = b[block.MEAN_Y + q]
    columns[i, PRECISION_X] = b[block.PRECISION_X + q]
    columns[i, SHEAR] = b[block.SHEAR + q]
    columns[i, PRECISION_Y] = b[block.PRECISION_Y + q]
    columns[i, OPACITY] = b[block.OPACITY + q]
    columns[i, RED] = max(ZERO, color[0])
    columns[i, GREEN] = max(ZERO, color[1])
    columns[i, BLUE] = max(ZERO, color[2])


@inline_jit
def _list_wanted(begin, end, wanted, rows):
    """List the wanted splats from `begin` to before `end`. Returns how many there are."""
    found = np.uint64(0)
    for i in range(np.uint64(begin), np.uint64(end)):
        rows[found] = i
        found += np.uint64(wanted[i])
    return np.int64(found)


@parallel(lambda wanted, *_: len(wanted), piece=SPLATS_PER_PIECE)
def project_forward(
    work, wanted, covered, splats, face, frames, degree, depth_as_color, antialiased, projection
):
    """Write the rows of `projection` of the splats that are wanted, (N,) bool; the tuples are those
    of `layout.py`.

    covered (tiles_y + 1, tiles_x + 1) int32: how many tiles above and to the left are rendered; a
    splat's bounds end at these, and one that reaches none of them counts as not visible. face (N,)
    int32.
    degree: of the spherical harmonics used, at most the stored one.
    depth_as_color: blend (depth, 0, 0) instead of the color. antialiased: what LOW_PASS_PX2 adds to
    a splat's area is taken from its opacity (Mip-Splatting's 2D filter, gsplat's "antialiased"
    mode).
    """
    call_helpers(work)
    tiles_x = (frames.size[0] + TILE - 1) // TILE
    tiles_y = (frames.size[1] + TILE - 1) // TILE
    limits = _tan_limits(frames.intrinsics, frames.size)
    coefficients = np.uint64((degree + 1) * (degree + 1))
    b = np.zeros(block.FORWARD_SIZE, np.float32)
    visible = np.empty(BLOCK_SPLATS, np.uint64)
    rows = np.empty(SPLATS_PER_PIECE, np.int64)
    for begin, end in pieces(work):
        found = _list_wanted(begin, end, wanted, rows)
        for first in range(0, found, BLOCK_SPLATS):
            some = rows[first : min(found, first + BLOCK_SPLATS)]
            _load(some, splats, face, frames, b)
            block.project_geometry(b, frames.intrinsics, limits)
            if antialiased:
                block.compensate_low_pass(b)
            block.project_bounds(b, np.float32(tiles_x), np.float32(tiles_y))
            count = _list_visible(some, covered, projection.rect, b, visible)
            if count == 0:
                continue
            block.compute_harmonics(b, frames.to_world)
            for n in range(count):
                q = visible[n]
                i = np.uint64(some[q])
                red, green, blue = _color(b, q, i, coefficients, splats.sh)
                if frames.color.shape[1] > 0:
                    f = np.uint64(face[i])
                    red = red + frames.color[f, 0]
                    green = green + frames.color[f, 1]
                    blue = blue + frames.color[f, 2]
                _store(b, q, i, (red, green, blue), projection, depth_as_color)


@part_jit
def _sum_pairs(rows, lists, pair_gradients, b):
    """Sum the gradients of each listed splat's pairs to the block, while memory is asked for those
    of the next splats, which lie all over it."""
    first_pair = lists.first_pair
    pairs = lists.pairs
    splat_pairs = lists.splat_pairs
    grads = pair_gradients
    last_pair = len(splat_pairs) - 1
    for q in range(np.uint64(len(rows))):
        i = np.uint64(rows[q])
        g0 = g1 = g2 = g3 = g4 = g5 = g6 = g7 = g8 = ZERO
        for k in range(first_pair[i], first_pair[i] + pairs[i]):
            ahead = np.uint64(splat_pairs[np.uint64(min(k + PAIRS_AHEAD, last_pair))])
            prefetch(grads, ahead * np.uint64(PROJECTED))
            prefetch(grads, ahead * np.uint64(PROJECTED) + np.uint64(PROJECTED - 1))
            j = np.uint64(splat_pairs[np.uint64(k)])
            g0 = g0 + grads[j, 0]
            g1 = g1 + grads[j, 1]
            g2 = g2 + grads[j, 2]
            g3 = g3 + grads[j, 3]
            g4 = g4 + grads[j, 4]
            g5 = g5 + grads[j, 5]
            g6 = g6 + grads[j, 6]
            g7 = g7 + grads[j, 7]
            g8 = g8 + grads[j, 8]
        b[block.G_MEAN_X + q] = g0
        b[block.G_MEAN_Y + q] = g1
        b[block.G_PRECISION_X + q] = g2
        b[block.G_SHEAR + q] = g3
        b[block.G_PRECISION_Y + q] = g4
        b[block.G_OPACITY + q] = g5
        b[block.G_RED + q] = g6
        b[block.G_GREEN + q] = g7
        b[block.G_BLUE + q] = g8


@part_jit
def _load_projected(rows, projected, b):
    """Copy the listed splats' columns to the block, and clear the gradient of colors that were cut
    at zero."""
    for q in range(np.uint64(len(rows))):
        i = np.uint64(rows[q])
        b[block.PRECISION_X + q] = projected[i, PRECISION_X]
        b[block.SHEAR + q] = projected[i, SHEAR]
        b[block.PRECISION_Y + q] = projected[i, PRECISION_Y]
        b[block.OPACITY + q] = projected[i, OPACITY]
        b[block.G_RED + q] = b[block.G_RED + q] if projected[i, RED] > ZERO else ZERO
        b[block.G_GREEN + q] = b[block.G_GREEN + q] if projected[i, GREEN] > ZERO else ZERO
        b[block.G_BLUE + q] = b[block.G_BLUE + q] if projected[i, BLUE] > ZERO else ZERO


@part_jit
def _color_gradient(rows, b, coefficients, sh, v_sh):
    """Write the gradients of the listed splats' coefficients in use to v_sh (≥ M, 3·K), and the
    weights of the harmonics to the block; sh (N, 3·K)."""
    three = np.uint64(3)
    for q in range(np.uint64(len(rows))):
        i = np.uint64(rows[q])
        red = b[block.G_RED + q]
        green = b[block.G_GREEN + q]
        blue = b[block.G_BLUE + q]
        for k in range(coefficients):
            harmonic = b[block.B0 + k * COLUMN + q]
            c = three * k
            v_sh[q, c] = harmonic * red
            v_sh[q, c + np.uint64(1)] = harmonic * green
            v_sh[q, c + np.uint64(2)] = harmonic * blue
            b[block.W0 + k * COLUMN + q] = (
                red * sh[i, c] + green * sh[i, c + np.uint64(1)] + blue * sh[i, c + np.uint64(2)]
            )
        for k in range(coefficients, np.uint64(block.BASIS_SIZE)):
            b[block.W0 + k * COLUMN + q] = ZERO


@part_jit
def _write_color_gradient(rows, v_sh, columns, gradient):
    for q in range(np.uint64(len(rows))):
        i = np.uint64(rows[q])
        for c in range(columns):
            gradient[i, c] = v_sh[q, c]


@part_jit
def _store_gradient(rows, b, gradients, screen_gradient):
    """Copy the gradients of the listed splats' geometry from the block."""
    xyz = gradients.xyz
    rotation = gradients.rotation
    log_scale = gradients.log_scale
    opacity = gradients.opacity
    for q in range(np.uint64(len(rows))):
        i = np.uint64(rows[q])
        xyz[i, 0] = b[block.V_LOCAL_X + q]
        xyz[i, 1] = b[block.V_LOCAL_Y + q]
        xyz[i, 2] = b[block.V_LOCAL_Z + q]
        opacity[i] = b[block.V_LOGIT + q]
        rotation[i, 0] = b[block.V_RAW_0 + q]
        rotation[i, 1] = b[block.V_RAW_1 + q]
        rotation[i, 2] = b[block.V_RAW_2 + q]
        rotation[i, 3] = b[block.V_RAW_3 + q]
        log_scale[i, 0] = b[block.V_LOG_0 + q]
        log_scale[i, 1] = b[block.V_LOG_1 + q]
        log_scale[i, 2] = b[block.V_LOG_2 + q]
        screen_gradient[i] = b[block.V_SCREEN + q]


@parallel(lambda visible, *_: len(visible), piece=SPLATS_PER_PIECE)
def project_backward(
    work,
    visible,
    splats,
    face,
    frames,
    degree,
    depth_as_color,
    antialiased,
    projected,
    lists,
    pair_gradients,
    gradients,
    screen_gradient,
    color,
):
    """Write the gradient of each listed splat to its row of `gradients`; the counterpart of
    `project_forward`.

    color: an `optimizer.ColorStep` of the coefficients in use, of whose gradients only those of the
    first harmonic are then written.

    visible (M,) int32: the splats to differentiate. projected (N, PROJECTED): the columns of the
    projection.
    pair_gradients (P, PROJECTED). Writes screen_gradient (N,) too: the length of the gradient with
    respect to the projected center in units of half the image, for density control.
    """
    call_helpers(work)
    half_size = HALF * np.float32(frames.size[0]), HALF * np.float32(frames.size[1])
    limits = _tan_limits(frames.intrinsics, frames.size)
    coefficients = np.uint64((degree + 1) * (degree + 1))
    compensated = ONE if antialiased else ZERO
    b = np.zeros(block.BACKWARD_SIZE, np.float32)
    v_sh = np.zeros((BLOCK_SPLATS, 3 * block.BASIS_SIZE), np.float32)
    corrections = np.empty((3, BLOCK_SPLATS), np.float32)
    places = np.arange(BLOCK_SPLATS)
    is_stepped = len(color.tables.rates) > 0
    written = np.uint64(3) if is_stepped else np.uint64(3) * coefficients
    for begin, end in pieces(work):
        for first in range(begin, end, BLOCK_SPLATS):
            some = visible[first : min(end, first + BLOCK_SPLATS)]
            _load(some, splats, face, frames, b)
            _sum_pairs(some, lists, pair_gradients, b)
            _load_projected(some, projected, b)
            block.differentiate_geometry(b, frames.intrinsics, limits, half_size, compensated)
            block.compute_harmonics(b, frames.to_world)
            if depth_as_color:
                for q in range(np.uint64(len(some))):
                    b[block.V_CAMERA_Z + q] += b[block.G_RED + q]
                    b[block.G_RED + q] = b[block.G_GREEN + q] = b[block.G_BLUE + q] = ZERO
            _color_gradient(some, b, coefficients, color.tables.value, v_sh)
            _write_color_gradient(some, v_sh, written, color.tables.gradient)
            if is_stepped:
                correct_bias(some, color.steps, color.options, corrections)
                adam_block(some, places, color.tables, v_sh, corrections, color.options)
            block.differentiate_position(b, frames.to_world)
            _store_gradient(some, b, gradients, screen_gradient)
