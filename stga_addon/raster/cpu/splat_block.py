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
# The splat's frame in camera space and its parameters.
(M00, M01, M02, M10, M11, M12, M20, M21, M22, ORIGIN_X, ORIGIN_Y, ORIGIN_Z, LOCAL_X, LOCAL_Y,
 LOCAL_Z, RAW_0, RAW_1, RAW_2, RAW_3, LOG_0, LOG_1, LOG_2, LOGIT) = (
    np.uint64(n * BLOCK_SPLATS) for n in range(23))  # fmt: skip
# On the screen: the geometry of `layout.Projection`; the covariance, its determinant, and that of
# the splat without LOW_PASS_PX2; bounds in tiles; SEEN: 1 where the splat may be visible, −1 where
# it is not finite, else 0.
(MEAN_X, MEAN_Y, PRECISION_X, SHEAR, PRECISION_Y, OPACITY, EXTENT_Y, XX, XY, YY, DETERMINANT, SHARP,
 X0, Y0, X1, Y1, SEEN) = (np.uint64(n * BLOCK_SPLATS) for n in range(23, 40))  # fmt: skip
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
def _rotation(q0, q1, q2, q3):
    """Rotation matrix entries of a unit quaternion wxyz."""
    return (
        ONE - TWO * (q2 * q2 + q3 * q3),
        TWO * (q1 * q2 - q0 * q3),
        TWO * (q1 * q3 + q0 * q2),
        TWO * (q1 * q2 + q0 * q3),
        ONE - TWO * (q1 * q1 + q3 * q3),
        TWO * (q2 * q3 - q0 * q1),
        TWO * (q1 * q3 - q0 * q2),
        TWO * (q2 * q3 + q0 * q1),
        ONE - TWO * (q1 * q1 + q2 * q2),
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
    return q0 * rn, q1 * rn, q2 * rn, q3 * rn, per_norm


@inline_jit
def _camera_point(b, q):
    """The splat in camera space."""
    x = b[LOCAL_X + q]
    y = b[LOCAL_Y + q]
    z = b[LOCAL_Z + q]
    return (
        b[M00 + q] * x + b[M01 + q] * y + b[M02 + q] * z + b[ORIGIN_X + q],
        b[M10 + q] * x + b[M11 + q] * y + b[M12 + q] * z + b[ORIGIN_Y + q],
        b[M20 + q] * x + b[M21 + q] * y + b[M22 + q] * z + b[ORIGIN_Z + q],
    )


@inline_jit
def _pixels_per_local(b, q, jx, jy, tx, ty):
    """The affine map U from the triangle's local frame to pixels, row by row: the projection's
    Jacobian times its matrix.

    jx, jy: focal lengths over depth; tx, ty: x and y over depth.
    """
    m20 = b[M20 + q]
    m21 = b[M21 + q]
    m22 = b[M22 + q]
    return (
        jx * (b[M00 + q] - tx * m20),
        jx * (b[M01 + q] - tx * m21),
        jx * (b[M02 + q] - tx * m22),
        jy * (b[M10 + q] - ty * m20),
        jy * (b[M11 + q] - ty * m21),
        jy * (b[M12 + q] - ty * m22),
    )


@inline_jit
def _row_times_matrix(a0, a1, a2, r00, r01, r02, r10, r11, r12, r20, r21, r22):
    return (
        a0 * r00 + a1 * r10 + a2 * r20,
        a0 * r01 + a1 * r11 + a2 * r21,
        a0 * r02 + a1 * r12 + a2 * r22,
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
    low_x = limits[0]
    high_x = limits[1]
    low_y = limits[2]
    high_y = limits[3]
    for q in range(np.uint64(BLOCK_SPLATS)):
        x, y, z = _camera_point(b, q)
        rz = ONE / z
        tx = min(high_x, max(low_x, x * rz))
        ty = min(high_y, max(low_y, y * rz))
        q0, q1, q2, q3, _ = _unit(b, q)
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(q0, q1, q2, q3)
        u00, u01, u02, u10, u11, u12 = _pixels_per_local(b, q, fx * rz, fy * rz, tx, ty)
        s0 = exponential(b[LOG_0 + q])
        s1 = exponential(b[LOG_1 + q])
        s2 = exponential(b[LOG_2 + q])
        w00, w01, w02 = _row_times_matrix(
            u00, u01, u02, r00, r01, r02, r10, r11, r12, r20, r21, r22
        )
        w10, w11, w12 = _row_times_matrix(
            u10, u11, u12, r00, r01, r02, r10, r11, r12, r20, r21, r22
        )
        a00 = w00 * s0
        a01 = w01 * s1
        a02 = w02 * s2
        a10 = w10 * s0
        a11 = w11 * s1
        a12 = w12 * s2
        xx = a00 * a00 + a01 * a01 + a02 * a02 + LOW_PASS_PX2
        yy = a10 * a10 + a11 * a11 + a12 * a12 + LOW_PASS_PX2
        # det of A·Aᵀ + low·I as squared 2×2 minors plus positive terms: never cancels to zero or
        # below.
        m01 = a00 * a11 - a01 * a10
        m02 = a00 * a12 - a02 * a10
        m12 = a01 * a12 - a02 * a11
        sharp = m01 * m01 + m02 * m02 + m12 * m12
        b[CAMERA_X + q] = x
        b[CAMERA_Y + q] = y
        b[CAMERA_Z + q] = z
        b[MEAN_X + q] = fx * x * rz + cx
        b[MEAN_Y + q] = fy * y * rz + cy
        b[XX + q] = xx
        b[XY + q] = a00 * a10 + a01 * a11 + a02 * a12
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
    """Write PRECISION_X, SHEAR, PRECISION_Y, EXTENT_Y, X0 to Y1 and SEEN; tiles_x, tiles_y
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
        b[PRECISION_X + q], b[SHEAR + q], b[PRECISION_Y + q] = yy / det, b[XY + q] / yy, ONE / yy
        b[EXTENT_Y + q] = ey
        b[X0 + q] = min(tiles_x, max(ZERO, np.floor((mean_x - ex) / size)))
        b[X1 + q] = min(tiles_x, max(ZERO, np.ceil((mean_x + ex) / size)))
        b[Y0 + q] = min(tiles_y, max(ZERO, np.floor((mean_y - ey) / size)))
        b[Y1 + q] = min(tiles_y, max(ZERO, np.ceil((mean_y + ey) / size)))
        finite = (opacity >= ZERO) & (det < infinite)
        finite = finite & (abs(mean_x) < infinite) & (abs(mean_y) < infinite)
        seen = (ONE if reach > ZERO else ZERO) if finite else -ONE
        b[SEEN + q] = ZERO if b[CAMERA_Z + q] < NEAR_M else seen


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
def basis_gradient(x, y, z, w1, w2, w3, w4, w5, w6, w7, w8, w9, w10, w11, w12, w13, w14, w15):
    """Gradient with respect to (x, y, z) of the sum of the harmonics 1 to 15 with these weights."""
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
    t00 = to_world[0, 0]
    t01 = to_world[0, 1]
    t02 = to_world[0, 2]
    t10 = to_world[1, 0]
    t11 = to_world[1, 1]
    t12 = to_world[1, 2]
    t20 = to_world[2, 0]
    t21 = to_world[2, 1]
    t22 = to_world[2, 2]
    for q in range(np.uint64(BLOCK_SPLATS)):
        x = b[CAMERA_X + q]
        y = b[CAMERA_Y + q]
        z = b[CAMERA_Z + q]
        rd = ONE / math.sqrt(x * x + y * y + z * z)
        dx = (t00 * x + t01 * y + t02 * z) * rd
        dy = (t10 * x + t11 * y + t12 * z) * rd
        dz = (t20 * x + t21 * y + t22 * z) * rd
        b[TOWARD_X + q] = dx
        b[TOWARD_Y + q] = dy
        b[TOWARD_Z + q] = dz
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
def _compensation_gradient(v, a00, a01, a02, a10, a11, a12, m01, m02, m12):
    """Gradient with respect to A's two rows of v·ln sqrt(sharp / det), as in
    `compensate_low_pass`."""
    low = LOW_PASS_PX2
    sharp = m01 * m01 + m02 * m02 + m12 * m12
    xx = a00 * a00 + a01 * a01 + a02 * a02
    yy = a10 * a10 + a11 * a11 + a12 * a12
    det = sharp + low * (xx + yy + low)
    # v holds sqrt(sharp) as a factor, so the quotient stays finite where a splat has no area and v
    # = 0.
    w = v * low * (xx + yy + low) / (det * max(sharp, np.float32(1e-30)))
    u = -v * low / det
    return (
        w * (m01 * a11 + m02 * a12) + u * a00,
        w * (-m01 * a10 + m12 * a12) + u * a01,
        w * (-m02 * a10 - m12 * a11) + u * a02,
        w * (-m01 * a01 - m02 * a02) + u * a10,
        w * (m01 * a00 - m12 * a02) + u * a11,
        w * (m02 * a00 + m12 * a01) + u * a12,
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
    low_x = limits[0]
    high_x = limits[1]
    low_y = limits[2]
    high_y = limits[3]
    for q in range(np.uint64(BLOCK_SPLATS)):
        g_mean_x = b[G_MEAN_X + q]
        g_mean_y = b[G_MEAN_Y + q]
        g_opacity = b[G_OPACITY + q]
        half_x = half_width * g_mean_x
        half_y = half_height * g_mean_y
        b[V_SCREEN + q] = math.sqrt(half_x * half_x + half_y * half_y)
        x, y, z = _camera_point(b, q)
        rz = ONE / z
        slope_x = x * rz
        slope_y = y * rz
        tx = min(high_x, max(low_x, slope_x))
        ty = min(high_y, max(low_y, slope_y))
        q0, q1, q2, q3, rn = _unit(b, q)
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(q0, q1, q2, q3)
        jx = fx * rz
        jy = fy * rz
        u00, u01, u02, u10, u11, u12 = _pixels_per_local(b, q, jx, jy, tx, ty)
        s0 = exponential(b[LOG_0 + q])
        s1 = exponential(b[LOG_1 + q])
        s2 = exponential(b[LOG_2 + q])
        w00, w01, w02 = _row_times_matrix(
            u00, u01, u02, r00, r01, r02, r10, r11, r12, r20, r21, r22
        )
        w10, w11, w12 = _row_times_matrix(
            u10, u11, u12, r00, r01, r02, r10, r11, r12, r20, r21, r22
        )
        a00 = w00 * s0
        a01 = w01 * s1
        a02 = w02 * s2
        a10 = w10 * s0
        a11 = w11 * s1
        a12 = w12 * s2

        # The x precision is 1 / s, s = xx − shear·xy. With rows a0, a1 of A and the residual e = a0
        # − shear·a1, ds = 2·e·(da0 − shear·da1) and dshear = (a1·(da0 − shear·da1) + e·da1) / yy:
        # the gradient with respect to a0 is v0, that with respect to a1 is −shear·v0 + v1. The
        # residual, and every product of −shear·v0 with something of row 1, is taken together with
        # row 0, because the two cancel for long splats.
        precision_x = b[PRECISION_X + q]
        shear = b[SHEAR + q]
        inverse_yy = b[PRECISION_Y + q]
        m01 = a00 * a11 - a01 * a10
        m02 = a00 * a12 - a02 * a10
        m12 = a01 * a12 - a02 * a11
        e0 = inverse_yy * (LOW_PASS_PX2 * a00 + a11 * m01 + a12 * m02)
        e1 = inverse_yy * (LOW_PASS_PX2 * a01 - a10 * m01 + a12 * m12)
        e2 = inverse_yy * (LOW_PASS_PX2 * a02 - a10 * m02 - a11 * m12)
        vs = -TWO * precision_x * precision_x * b[G_PRECISION_X + q]
        vk = inverse_yy * b[G_SHEAR + q]
        vw = -TWO * inverse_yy * inverse_yy * b[G_PRECISION_Y + q]
        b00, b01, b02, b10, b11, b12 = _compensation_gradient(
            compensated * g_opacity * b[OPACITY + q], a00, a01, a02, a10, a11, a12, m01, m02, m12
        )
        v00 = vs * e0 + vk * a10 + b00
        v01 = vs * e1 + vk * a11 + b01
        v02 = vs * e2 + vk * a12 + b02
        v10 = vk * e0 + vw * a10 + b10 + shear * b00
        v11 = vk * e1 + vw * a11 + b11 + shear * b01
        v12 = vk * e2 + vw * a12 + b12 + shear * b02
        by0 = v00 * e0 + v10 * a10
        by1 = v01 * e1 + v11 * a11
        by2 = v02 * e2 + v12 * a12
        b[V_LOG_0 + q] = by0
        b[V_LOG_1 + q] = by1
        b[V_LOG_2 + q] = by2
        # A = U·R·diag(s): to R, then through the normalized quaternion.
        v00 = v00 * s0
        v01 = v01 * s1
        v02 = v02 * s2
        v10 = v10 * s0
        v11 = v11 * s1
        v12 = v12 * s2
        p0 = u00 - shear * u10
        p1 = u01 - shear * u11
        p2 = u02 - shear * u12
        h00 = p0 * v00 + u10 * v10
        h01 = p0 * v01 + u10 * v11
        h02 = p0 * v02 + u10 * v12
        h10 = p1 * v00 + u11 * v10
        h11 = p1 * v01 + u11 * v11
        h12 = p1 * v02 + u11 * v12
        h20 = p2 * v00 + u12 * v10
        h21 = p2 * v01 + u12 * v11
        h22 = p2 * v02 + u12 * v12
        vq0 = TWO * (q3 * (h10 - h01) + q2 * (h02 - h20) + q1 * (h21 - h12))
        vq1 = TWO * (
            q2 * (h01 + h10) + q3 * (h02 + h20) + q0 * (h21 - h12) - TWO * q1 * (h11 + h22)
        )
        vq2 = TWO * (
            q1 * (h01 + h10) + q3 * (h12 + h21) + q0 * (h02 - h20) - TWO * q2 * (h00 + h22)
        )
        vq3 = TWO * (
            q1 * (h02 + h20) + q2 * (h12 + h21) + q0 * (h10 - h01) - TWO * q3 * (h00 + h11)
        )
        radial = vq0 * q0 + vq1 * q1 + vq2 * q2 + vq3 * q3
        b[V_RAW_0 + q] = (vq0 - radial * q0) * rn
        b[V_RAW_1 + q] = (vq1 - radial * q1) * rn
        b[V_RAW_2 + q] = (vq2 - radial * q2) * rn
        b[V_RAW_3 + q] = (vq3 - radial * q3) * rn
        # to U, and through it to the camera-space position (the Jacobian depends on it).
        d00 = v00 * r00 + v01 * r01 + v02 * r02
        d01 = v00 * r10 + v01 * r11 + v02 * r12
        d02 = v00 * r20 + v01 * r21 + v02 * r22
        d10 = v10 * r00 + v11 * r01 + v12 * r02
        d11 = v10 * r10 + v11 * r11 + v12 * r12
        d12 = v10 * r20 + v11 * r21 + v12 * r22
        m20 = b[M20 + q]
        m21 = b[M21 + q]
        m22 = b[M22 + q]
        from_row_0 = d00 * m20 + d01 * m21 + d02 * m22
        vtx = -jx * from_row_0
        vty = -jy * (d10 * m20 + d11 * m21 + d12 * m22 - shear * from_row_0)
        vtx = vtx if tx == slope_x else ZERO
        vty = vty if ty == slope_y else ZERO
        vtx = vtx + g_mean_x * fx
        vty = vty + g_mean_y * fy
        b[V_CAMERA_X + q] = vtx * rz
        b[V_CAMERA_Y + q] = vty * rz
        # U shrinks with z as the scales do.
        b[V_CAMERA_Z + q] = -rz * (by0 + by1 + by2) - (vtx * slope_x + vty * slope_y) * rz
        b[CAMERA_X + q] = x
        b[CAMERA_Y + q] = y
        b[CAMERA_Z + q] = z
        # σ(−x) instead of 1 − σ(x), which cancels for nearly opaque splats.
        b[V_LOGIT + q] = g_opacity * b[OPACITY + q] / (ONE + exponential(b[LOGIT + q]))


@inline_jit
def differentiate_position(b, to_world):
    """Write V_LOCAL_X to V_LOCAL_Z from V_CAMERA_X to V_CAMERA_Z and the weights W1 to W15 of the
    harmonics."""
    t00 = to_world[0, 0]
    t01 = to_world[0, 1]
    t02 = to_world[0, 2]
    t10 = to_world[1, 0]
    t11 = to_world[1, 1]
    t12 = to_world[1, 2]
    t20 = to_world[2, 0]
    t21 = to_world[2, 1]
    t22 = to_world[2, 2]
    for q in range(np.uint64(BLOCK_SPLATS)):
        dx = b[TOWARD_X + q]
        dy = b[TOWARD_Y + q]
        dz = b[TOWARD_Z + q]
        rd = b[PER_DISTANCE + q]
        ex, ey, ez = basis_gradient(
            dx,
            dy,
            dz,
            b[W1 + q],
            b[W2 + q],
            b[W3 + q],
            b[W4 + q],
            b[W5 + q],
            b[W6 + q],
            b[W7 + q],
            b[W8 + q],
            b[W9 + q],
            b[W10 + q],
            b[W11 + q],
            b[W12 + q],
            b[W13 + q],
            b[W14 + q],
            b[W15 + q],
        )
        along = ex * dx + ey * dy + ez * dz
        ex = (ex - along * dx) * rd
        ey = (ey - along * dy) * rd
        ez = (ez - along * dz) * rd
        vx = b[V_CAMERA_X + q] + t00 * ex + t10 * ey + t20 * ez
        vy = b[V_CAMERA_Y + q] + t01 * ex + t11 * ey + t21 * ez
        vz = b[V_CAMERA_Z + q] + t02 * ex + t12 * ey + t22 * ez
        b[V_LOCAL_X + q] = b[M00 + q] * vx + b[M10 + q] * vy + b[M20 + q] * vz
        b[V_LOCAL_Y + q] = b[M01 + q] * vx + b[M11 + q] * vy + b[M21 + q] * vz
        b[V_LOCAL_Z + q] = b[M02 + q] * vx + b[M12 + q] * vy + b[M22 + q] * vz
