"""Projection of a block of splats, forward and backward, in loops that LLVM vectorizes.

The values of a block lie in one flat float32 array `b`: column C of splat q at b[C + q]. Every loop
computes all BLOCK_SPLATS, whatever an earlier block has left behind the last splat, so that a
splat's bits do not depend on its place. `project` copies to the array, and from it, what is
scattered in memory.
"""

import math

import numpy as np

from . import inline_jit
from .elementary import exponential, logarithm
from .layout import TILE

LOW_PASS_PX2 = np.float32(0.3)
"""Added to the projected covariance's diagonal, px²: no splat is narrower than a pixel."""
NEAR_M = np.float32(0.01)
QUATERNION_LIFT = np.float32(2.0**90)
ZERO, HALF, ONE, TWO, THREE, FOUR, SIX, EIGHT = (np.float32(n) for n in (0, 0.5, 1, 2, 3, 4, 6, 8))
# The normalization constants of spherical harmonics, in order of first use.
C0, C1, C2, C3, C4, C5, C6, C7, C8, C9 = (np.float32(c) for c in (
    0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005,
    0.5462742152960396, 0.5900435899266435, 2.890611442640554, 0.4570457994644658,
    0.3731763325901154, 1.445305721320277,
))  # fmt: skip

BLOCK_SPLATS = 64
BASIS_SIZE = 16
COLUMN = np.uint64(BLOCK_SPLATS)
TWO_COLUMNS = np.uint64(2 * BLOCK_SPLATS)
# The splat's frame in camera space and its parameters.
(M00, M01, M02, M10, M11, M12, M20, M21, M22, ORIGIN_X, ORIGIN_Y, ORIGIN_Z, LOCAL_X, LOCAL_Y,
 LOCAL_Z, RAW_0, RAW_1, RAW_2, RAW_3, LOG_0, LOG_1, LOG_2, LOGIT) = (
    np.uint64(n * BLOCK_SPLATS) for n in range(23))  # fmt: skip
# On the screen: the geometry of `layout.Projection`; the covariance, its determinant, and that of
# the splat without LOW_PASS_PX2; bounds in tiles; VISIBLE: 1 where the splat may be visible, −1
# where it is not finite, else 0.
(MEAN_X, MEAN_Y, PRECISION_X, SHEAR, PRECISION_Y, OPACITY, EXTENT_Y, XX, XY, YY, DETERMINANT, SHARP,
 X0, Y0, X1, Y1, VISIBLE) = (np.uint64(n * BLOCK_SPLATS) for n in range(23, 40))  # fmt: skip
# In camera space; the unit vector from the camera in world space, 1 / distance; and the harmonics
# of the vector.
(CAMERA_X, CAMERA_Y, CAMERA_Z, TOWARD_X, TOWARD_Y, TOWARD_Z, PER_DISTANCE) = (
    np.uint64(n * BLOCK_SPLATS) for n in range(40, 47)
)
(B0, B1, B2, B3, B4, B5, B6, B7, B8, B9, B10, B11, B12, B13, B14, B15) = (
    np.uint64(n * BLOCK_SPLATS) for n in range(47, 63)
)
FORWARD_SIZE = 63 * BLOCK_SPLATS
# Gradients: of the columns of `layout.Projection`, and of the red, green and blue of harmonic k
# together; of the splat's parameters and its place in camera space; the length of the center's, in
# units of half the image.
G_MEAN_X, G_MEAN_Y, G_PRECISION_X, G_SHEAR, G_PRECISION_Y, G_OPACITY, G_RED, G_GREEN, G_BLUE = (
    np.uint64(n * BLOCK_SPLATS) for n in range(63, 72)
)
W0, W1, W2, W3, W4, W5, W6, W7, W8, W9, W10, W11, W12, W13, W14, W15 = (
    np.uint64(n * BLOCK_SPLATS) for n in range(72, 88)
)
(V_LOCAL_X, V_LOCAL_Y, V_LOCAL_Z, V_RAW_0, V_RAW_1, V_RAW_2, V_RAW_3, V_LOG_0, V_LOG_1, V_LOG_2,
 V_LOGIT, V_CAMERA_X, V_CAMERA_Y, V_CAMERA_Z, V_SCREEN) = (
    np.uint64(n * BLOCK_SPLATS) for n in range(88, 103))  # fmt: skip
BACKWARD_SIZE = 103 * BLOCK_SPLATS


@inline_jit
def _three(b, column, q):
    """Splat q's values in the column and the two after it."""
    return b[column + q], b[column + COLUMN + q], b[column + TWO_COLUMNS + q]


@inline_jit
def _store_three(b, column, q, values):
    b[column + q] = values[0]
    b[column + COLUMN + q] = values[1]
    b[column + TWO_COLUMNS + q] = values[2]


@inline_jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline_jit
def _times(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inline_jit
def _row_times_matrix(a, rows):
    return (
        a[0] * rows[0][0] + a[1] * rows[1][0] + a[2] * rows[2][0],
        a[0] * rows[0][1] + a[1] * rows[1][1] + a[2] * rows[2][1],
        a[0] * rows[0][2] + a[1] * rows[1][2] + a[2] * rows[2][2],
    )


@inline_jit
def _matrix_times(rows, a):
    return _dot(a, rows[0]), _dot(a, rows[1]), _dot(a, rows[2])


@inline_jit
def _minors(a0, a1):
    """The three 2 × 2 determinants of two rows: of columns 0 and 1, 0 and 2, 1 and 2."""
    return (
        a0[0] * a1[1] - a0[1] * a1[0],
        a0[0] * a1[2] - a0[2] * a1[0],
        a0[1] * a1[2] - a0[2] * a1[1],
    )


@inline_jit
def _rows(matrix):
    """A matrix (3, 3) as tuples."""
    return (
        (matrix[0, 0], matrix[0, 1], matrix[0, 2]),
        (matrix[1, 0], matrix[1, 1], matrix[1, 2]),
        (matrix[2, 0], matrix[2, 1], matrix[2, 2]),
    )


@inline_jit
def _rotation(unit):
    """Rotation matrix, row by row, of a unit quaternion wxyz."""
    q0, q1, q2, q3 = unit
    return (
        (ONE - TWO * (q2 * q2 + q3 * q3), TWO * (q1 * q2 - q0 * q3), TWO * (q1 * q3 + q0 * q2)),
        (TWO * (q1 * q2 + q0 * q3), ONE - TWO * (q1 * q1 + q3 * q3), TWO * (q2 * q3 - q0 * q1)),
        (TWO * (q1 * q3 - q0 * q2), TWO * (q2 * q3 + q0 * q1), ONE - TWO * (q1 * q1 + q2 * q2)),
    )


@inline_jit
def _unit(b, q):
    """Unit quaternion and 1 / norm of a quaternion of any length; zero counts as the identity, with
    1 / norm = 0.

    The squares of 1e-20 and 1e20 leave float32's range, so quaternions far from length one are
    first scaled by a power of two. 1 / norm only serves the gradient, whose square must stay in
    range too: it ends at 1e12.
    """
    q0 = b[RAW_0 + q]
    q1 = b[RAW_1 + q]
    q2 = b[RAW_2 + q]
    q3 = b[RAW_3 + q]
    size = abs(q0) + abs(q1) + abs(q2) + abs(q3)
    up = QUATERNION_LIFT
    down = ONE / QUATERNION_LIFT
    lift = up if size < np.float32(1e-12) else (down if size > np.float32(1e12) else ONE)
    q0 = ONE if size == ZERO else q0 * lift
    q1 = q1 * lift
    q2 = q2 * lift
    q3 = q3 * lift
    rn = ONE / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    per_norm = ZERO if size == ZERO else min(rn * lift, np.float32(1e12))
    return (q0 * rn, q1 * rn, q2 * rn, q3 * rn), per_norm


@inline_jit
def _frame(b, q):
    """The triangle's matrix to camera space, row by row."""
    return _three(b, M00, q), _three(b, M10, q), _three(b, M20, q)


@inline_jit
def _camera_point(b, q):
    """The splat in camera space."""
    local = _three(b, LOCAL_X, q)
    m = _frame(b, q)
    return (
        _dot(m[0], local) + b[ORIGIN_X + q],
        _dot(m[1], local) + b[ORIGIN_Y + q],
        _dot(m[2], local) + b[ORIGIN_Z + q],
    )


@inline_jit
def _pixels_per_local(b, q, j, slopes):
    """The affine map U from the triangle's local frame to pixels, row by row: the projection's
    Jacobian times its matrix.

    j: focal lengths over depth; slopes: x and y over depth.
    """
    m = _frame(b, q)
    tx, ty = slopes
    return (
        (
            j[0] * (m[0][0] - tx * m[2][0]),
            j[0] * (m[0][1] - tx * m[2][1]),
            j[0] * (m[0][2] - tx * m[2][2]),
        ),
        (
            j[1] * (m[1][0] - ty * m[2][0]),
            j[1] * (m[1][1] - ty * m[2][1]),
            j[1] * (m[1][2] - ty * m[2][2]),
        ),
    )


@inline_jit
def _clamped(slopes, limits):
    """x / z and y / z within limits (4,): lowest and highest of x / z, of y / z."""
    return (
        min(limits[1], max(limits[0], slopes[0])),
        min(limits[3], max(limits[2], slopes[1])),
    )


@inline_jit
def project_geometry(b, intrinsics, limits):
    """Write MEAN_X and MEAN_Y, XX to SHARP, OPACITY and CAMERA_X to CAMERA_Z.

    intrinsics (4,): fl_x, fl_y, cx, cy. limits (4,): lowest and highest x / z and y / z in the
    projection's Jacobian.
    """
    fx = intrinsics[0]
    fy = intrinsics[1]
    cx = intrinsics[2]
    cy = intrinsics[3]
    bounds = (limits[0], limits[1], limits[2], limits[3])
    for q in range(np.uint64(BLOCK_SPLATS)):
        x, y, z = _camera_point(b, q)
        rz = ONE / z
        slopes = _clamped((x * rz, y * rz), bounds)
        unit, _ = _unit(b, q)
        rotation = _rotation(unit)
        u0, u1 = _pixels_per_local(b, q, (fx * rz, fy * rz), slopes)
        s0 = exponential(b[LOG_0 + q])
        s1 = exponential(b[LOG_1 + q])
        s2 = exponential(b[LOG_2 + q])
        scales = (s0, s1, s2)
        a0 = _times(_row_times_matrix(u0, rotation), scales)
        a1 = _times(_row_times_matrix(u1, rotation), scales)
        xx = _dot(a0, a0) + LOW_PASS_PX2
        yy = _dot(a1, a1) + LOW_PASS_PX2
        # det of A·Aᵀ + low·I as squared 2×2 minors plus positive terms: never cancels to zero or
        # below.
        minors = _minors(a0, a1)
        sharp = _dot(minors, minors)
        _store_three(b, CAMERA_X, q, (x, y, z))
        b[MEAN_X + q] = fx * x * rz + cx
        b[MEAN_Y + q] = fy * y * rz + cy
        b[XX + q] = xx
        b[XY + q] = _dot(a0, a1)
        b[YY + q] = yy
        b[DETERMINANT + q] = sharp + LOW_PASS_PX2 * (xx + yy - LOW_PASS_PX2)
        b[SHARP + q] = sharp
        b[OPACITY + q] = ONE / (ONE + exponential(-b[LOGIT + q]))


@inline_jit
def compensate_low_pass(b):
    """Take from OPACITY what LOW_PASS_PX2 adds to the area."""
    for q in range(np.uint64(BLOCK_SPLATS)):
        b[OPACITY + q] *= math.sqrt(b[SHARP + q] / b[DETERMINANT + q])


@inline_jit
def project_bounds(b, tiles_x, tiles_y):
    """Write PRECISION_X, SHEAR, PRECISION_Y, EXTENT_Y, X0 to Y1 and VISIBLE; tiles_x, tiles_y
    float32."""
    size = np.float32(TILE)
    for q in range(np.uint64(BLOCK_SPLATS)):
        mean_x = b[MEAN_X + q]
        mean_y = b[MEAN_Y + q]
        det = b[DETERMINANT + q]
        opacity = b[OPACITY + q]
        reach = TWO * logarithm(np.float32(255.0) * opacity)
        yy = b[YY + q]
        infinite = np.float32(np.inf)
        ex = math.sqrt(reach * b[XX + q])
        ey = math.sqrt(reach * yy)
        b[PRECISION_X + q] = yy / det
        b[SHEAR + q] = b[XY + q] / yy
        b[PRECISION_Y + q] = ONE / yy
        b[EXTENT_Y + q] = ey
        b[X0 + q] = min(tiles_x, max(ZERO, np.floor((mean_x - ex) / size)))
        b[X1 + q] = min(tiles_x, max(ZERO, np.ceil((mean_x + ex) / size)))
        b[Y0 + q] = min(tiles_y, max(ZERO, np.floor((mean_y - ey) / size)))
        b[Y1 + q] = min(tiles_y, max(ZERO, np.ceil((mean_y + ey) / size)))
        finite = (opacity >= ZERO) & (det < infinite)
        finite = finite & (abs(mean_x) < infinite) & (abs(mean_y) < infinite)
        visible = (ONE if reach > ZERO else ZERO) if finite else -ONE
        b[VISIBLE + q] = ZERO if b[CAMERA_Z + q] < NEAR_M else visible


@inline_jit
def basis(x, y, z):
    """The 16 real spherical harmonics of the unit direction (x, y, z)."""
    xx = x * x
    yy = y * y
    zz = z * z
    return (
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2 * x * y,
        -C2 * y * z,
        C3 * (TWO * zz - xx - yy),
        -C2 * x * z,
        C4 * (xx - yy),
        -C5 * y * (THREE * xx - yy),
        C6 * x * y * z,
        -C7 * y * (FOUR * zz - xx - yy),
        C8 * z * (TWO * zz - THREE * xx - THREE * yy),
        -C7 * x * (FOUR * zz - xx - yy),
        C9 * z * (xx - yy),
        -C5 * x * (xx - THREE * yy),
    )


@inline_jit
def _basis_gradient(b, q, x, y, z):
    """Gradient with respect to the unit direction (x, y, z) of the sum of the harmonics 1 to 15
    with the splat's weights."""
    w1 = b[W1 + q]
    w2 = b[W2 + q]
    w3 = b[W3 + q]
    w4 = b[W4 + q]
    w5 = b[W5 + q]
    w6 = b[W6 + q]
    w7 = b[W7 + q]
    w8 = b[W8 + q]
    w9 = b[W9 + q]
    w10 = b[W10 + q]
    w11 = b[W11 + q]
    w12 = b[W12 + q]
    w13 = b[W13 + q]
    w14 = b[W14 + q]
    w15 = b[W15 + q]
    xx = x * x
    yy = y * y
    zz = z * z
    gx = -C1 * w3 + C2 * (y * w4 - z * w7) - TWO * C3 * x * w6 + TWO * C4 * x * w8
    gx += -C5 * SIX * x * y * w9 + C6 * y * z * w10 + C7 * TWO * x * y * w11
    gx += -C8 * SIX * x * z * w12 - C7 * (FOUR * zz - THREE * xx - yy) * w13
    gx += C9 * TWO * x * z * w14 - C5 * THREE * (xx - yy) * w15
    gy = -C1 * w1 + C2 * (x * w4 - z * w5) - TWO * C3 * y * w6 - TWO * C4 * y * w8
    gy += -C5 * THREE * (xx - yy) * w9 + C6 * x * z * w10
    gy += -C7 * (FOUR * zz - xx - THREE * yy) * w11 - C8 * SIX * y * z * w12
    gy += C7 * TWO * x * y * w13 - C9 * TWO * y * z * w14 + C5 * SIX * x * y * w15
    gz = C1 * w2 - C2 * (y * w5 + x * w7) + FOUR * C3 * z * w6 + C6 * x * y * w10
    gz += -C7 * EIGHT * y * z * w11 + C8 * (SIX * zz - THREE * xx - THREE * yy) * w12
    gz += -C7 * EIGHT * x * z * w13 + C9 * (xx - yy) * w14
    return gx, gy, gz


@inline_jit
def compute_harmonics(b, to_world):
    """Write TOWARD_X to PER_DISTANCE and B0 to B15; to_world (3, 3): rotation from camera to world
    space."""
    rows = _rows(to_world)
    for q in range(np.uint64(BLOCK_SPLATS)):
        point = _three(b, CAMERA_X, q)
        rd = ONE / math.sqrt(_dot(point, point))
        dx = _dot(rows[0], point) * rd
        dy = _dot(rows[1], point) * rd
        dz = _dot(rows[2], point) * rd
        _store_three(b, TOWARD_X, q, (dx, dy, dz))
        b[PER_DISTANCE + q] = rd
        (
            b[B0 + q],
            b[B1 + q],
            b[B2 + q],
            b[B3 + q],
            b[B4 + q],
            b[B5 + q],
            b[B6 + q],
            b[B7 + q],
            b[B8 + q],
            b[B9 + q],
            b[B10 + q],
            b[B11 + q],
            b[B12 + q],
            b[B13 + q],
            b[B14 + q],
            b[B15 + q],
        ) = basis(dx, dy, dz)


@inline_jit
def _compensation_gradient(v, a0, a1, minors):
    """Gradient with respect to A's two rows of v·ln sqrt(sharp / det), as in
    `compensate_low_pass`."""
    low = LOW_PASS_PX2
    m01, m02, m12 = minors
    sharp = _dot(minors, minors)
    xx = _dot(a0, a0)
    yy = _dot(a1, a1)
    det = sharp + low * (xx + yy + low)
    # v holds sqrt(sharp) as a factor, so the quotient stays finite where a splat has no area and v
    # = 0.
    w = v * low * (xx + yy + low) / (det * max(sharp, np.float32(1e-30)))
    u = -v * low / det
    return (
        (
            w * (m01 * a1[1] + m02 * a1[2]) + u * a0[0],
            w * (-m01 * a1[0] + m12 * a1[2]) + u * a0[1],
            w * (-m02 * a1[0] - m12 * a1[1]) + u * a0[2],
        ),
        (
            w * (-m01 * a0[1] - m02 * a0[2]) + u * a1[0],
            w * (m01 * a0[0] - m12 * a0[2]) + u * a1[1],
            w * (m02 * a0[0] + m12 * a0[1]) + u * a1[2],
        ),
    )


@inline_jit
def _shape_gradient(b, q, a0, a1, compensated):
    """Gradients v0 and v1 with respect to A's rows a0 and a1, the latter less −shear·v0, and those
    of the three log scales.

    The x precision is 1 / s, s = xx − shear·xy. With the residual e = a0 − shear·a1, ds = 2·e·(da0
    − shear·da1) and dshear = (a1·(da0 − shear·da1) + e·da1) / yy: the gradient with respect to a0
    is v0, that with respect to a1 is −shear·v0 + v1. The residual, and every product of −shear·v0
    with something of row 1, is taken together with row 0, because the two cancel for long splats.
    """
    precision_x = b[PRECISION_X + q]
    shear = b[SHEAR + q]
    inverse_yy = b[PRECISION_Y + q]
    minors = _minors(a0, a1)
    m01, m02, m12 = minors
    e0 = inverse_yy * (LOW_PASS_PX2 * a0[0] + a1[1] * m01 + a1[2] * m02)
    e1 = inverse_yy * (LOW_PASS_PX2 * a0[1] - a1[0] * m01 + a1[2] * m12)
    e2 = inverse_yy * (LOW_PASS_PX2 * a0[2] - a1[0] * m02 - a1[1] * m12)
    vs = -TWO * precision_x * precision_x * b[G_PRECISION_X + q]
    vk = inverse_yy * b[G_SHEAR + q]
    vw = -TWO * inverse_yy * inverse_yy * b[G_PRECISION_Y + q]
    of_opacity = compensated * b[G_OPACITY + q] * b[OPACITY + q]
    b0, b1 = _compensation_gradient(of_opacity, a0, a1, minors)
    v0 = (
        vs * e0 + vk * a1[0] + b0[0],
        vs * e1 + vk * a1[1] + b0[1],
        vs * e2 + vk * a1[2] + b0[2],
    )
    v1 = (
        vk * e0 + vw * a1[0] + b1[0] + shear * b0[0],
        vk * e1 + vw * a1[1] + b1[1] + shear * b0[1],
        vk * e2 + vw * a1[2] + b1[2] + shear * b0[2],
    )
    by_scale = (
        v0[0] * e0 + v1[0] * a1[0],
        v0[1] * e1 + v1[1] * a1[1],
        v0[2] * e2 + v1[2] * a1[2],
    )
    return v0, v1, by_scale


@inline_jit
def _quaternion_gradient(unit, h):
    """Gradient with respect to a unit quaternion, and its part along it, from that with respect to
    the rotation matrix, h."""
    q0, q1, q2, q3 = unit
    h0, h1, h2 = h
    v0 = TWO * (q3 * (h1[0] - h0[1]) + q2 * (h0[2] - h2[0]) + q1 * (h2[1] - h1[2]))
    v1 = TWO * (
        q2 * (h0[1] + h1[0])
        + q3 * (h0[2] + h2[0])
        + q0 * (h2[1] - h1[2])
        - TWO * q1 * (h1[1] + h2[2])
    )
    v2 = TWO * (
        q1 * (h0[1] + h1[0])
        + q3 * (h1[2] + h2[1])
        + q0 * (h0[2] - h2[0])
        - TWO * q2 * (h0[0] + h2[2])
    )
    v3 = TWO * (
        q1 * (h0[2] + h2[0])
        + q2 * (h1[2] + h2[1])
        + q0 * (h1[0] - h0[1])
        - TWO * q3 * (h0[0] + h1[1])
    )
    return (v0, v1, v2, v3), v0 * q0 + v1 * q1 + v2 * q2 + v3 * q3


@inline_jit
def _outer_sum(p, v0, u, v1):
    """p·v0ᵀ + u·v1ᵀ, row by row."""
    return (
        (p[0] * v0[0] + u[0] * v1[0], p[0] * v0[1] + u[0] * v1[1], p[0] * v0[2] + u[0] * v1[2]),
        (p[1] * v0[0] + u[1] * v1[0], p[1] * v0[1] + u[1] * v1[1], p[1] * v0[2] + u[1] * v1[2]),
        (p[2] * v0[0] + u[2] * v1[0], p[2] * v0[1] + u[2] * v1[1], p[2] * v0[2] + u[2] * v1[2]),
    )


@inline_jit
def differentiate_geometry(b, intrinsics, limits, half_size, compensated):
    """Write V_RAW_0 to V_LOGIT, V_SCREEN, V_CAMERA_X to V_CAMERA_Z without the harmonics' part, and
    CAMERA_X to CAMERA_Z, from G_MEAN_X to G_OPACITY and PRECISION_X to OPACITY.

    intrinsics, limits: as in `project_geometry`; half_size (2,): of the image, pixels; compensated:
    1 after `compensate_low_pass`, else 0; all float32.
    """
    fx = intrinsics[0]
    fy = intrinsics[1]
    half_width = half_size[0]
    half_height = half_size[1]
    bounds = (limits[0], limits[1], limits[2], limits[3])
    for q in range(np.uint64(BLOCK_SPLATS)):
        g_mean_x = b[G_MEAN_X + q]
        g_mean_y = b[G_MEAN_Y + q]
        half_x = half_width * g_mean_x
        half_y = half_height * g_mean_y
        b[V_SCREEN + q] = math.sqrt(half_x * half_x + half_y * half_y)
        x, y, z = _camera_point(b, q)
        rz = ONE / z
        slopes = (x * rz, y * rz)
        clamped = _clamped(slopes, bounds)
        unit, per_norm = _unit(b, q)
        rotation = _rotation(unit)
        jx = fx * rz
        jy = fy * rz
        u0, u1 = _pixels_per_local(b, q, (jx, jy), clamped)
        s0 = exponential(b[LOG_0 + q])
        s1 = exponential(b[LOG_1 + q])
        s2 = exponential(b[LOG_2 + q])
        scales = (s0, s1, s2)
        a0 = _times(_row_times_matrix(u0, rotation), scales)
        a1 = _times(_row_times_matrix(u1, rotation), scales)
        v0, v1, by_scale = _shape_gradient(b, q, a0, a1, compensated)
        _store_three(b, V_LOG_0, q, by_scale)
        # A = U·R·diag(s): to R, then through the normalized quaternion.
        v0 = _times(v0, scales)
        v1 = _times(v1, scales)
        shear = b[SHEAR + q]
        p = (u0[0] - shear * u1[0], u0[1] - shear * u1[1], u0[2] - shear * u1[2])
        v_unit, radial = _quaternion_gradient(unit, _outer_sum(p, v0, u1, v1))
        b[V_RAW_0 + q] = (v_unit[0] - radial * unit[0]) * per_norm
        b[V_RAW_1 + q] = (v_unit[1] - radial * unit[1]) * per_norm
        b[V_RAW_2 + q] = (v_unit[2] - radial * unit[2]) * per_norm
        b[V_RAW_3 + q] = (v_unit[3] - radial * unit[3]) * per_norm
        # to U, and through it to the camera-space position (the Jacobian depends on it).
        depth_row = _three(b, M20, q)
        from_row_0 = _dot(_matrix_times(rotation, v0), depth_row)
        vtx = -jx * from_row_0
        vty = -jy * (_dot(_matrix_times(rotation, v1), depth_row) - shear * from_row_0)
        vtx = (vtx if clamped[0] == slopes[0] else ZERO) + g_mean_x * fx
        vty = (vty if clamped[1] == slopes[1] else ZERO) + g_mean_y * fy
        b[V_CAMERA_X + q] = vtx * rz
        b[V_CAMERA_Y + q] = vty * rz
        # U shrinks with z as the scales do.
        by_size = by_scale[0] + by_scale[1] + by_scale[2]
        b[V_CAMERA_Z + q] = -rz * by_size - (vtx * slopes[0] + vty * slopes[1]) * rz
        _store_three(b, CAMERA_X, q, (x, y, z))
        # σ(−x) instead of 1 − σ(x), which cancels for nearly opaque splats.
        b[V_LOGIT + q] = b[G_OPACITY + q] * b[OPACITY + q] / (ONE + exponential(b[LOGIT + q]))


@inline_jit
def differentiate_position(b, to_world):
    """Write V_LOCAL_X to V_LOCAL_Z from V_CAMERA_X to V_CAMERA_Z and the weights W1 to W15 of the
    harmonics."""
    rows = _rows(to_world)
    for q in range(np.uint64(BLOCK_SPLATS)):
        dx, dy, dz = _three(b, TOWARD_X, q)
        rd = b[PER_DISTANCE + q]
        ex, ey, ez = _basis_gradient(b, q, dx, dy, dz)
        along = ex * dx + ey * dy + ez * dz
        ex = (ex - along * dx) * rd
        ey = (ey - along * dy) * rd
        ez = (ez - along * dz) * rd
        turned = _row_times_matrix((ex, ey, ez), rows)
        v = (
            b[V_CAMERA_X + q] + turned[0],
            b[V_CAMERA_Y + q] + turned[1],
            b[V_CAMERA_Z + q] + turned[2],
        )
        _store_three(b, V_LOCAL_X, q, _row_times_matrix(v, _frame(b, q)))
