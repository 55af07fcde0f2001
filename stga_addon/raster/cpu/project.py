"""Embedding, projection and color of every splat in one pass, forward and backward.

The face frames arrive already in camera space (composed in float64 by the caller), so a head far from the
world's origin loses nothing to float32, and embedded and world-space splats take the same path.
"""

import math

import numpy as np

from . import jit, part_jit
from .layout import BLUE, GREEN, MEAN_X, MEAN_Y, OPACITY, PRECISION_X, PRECISION_Y, PROJECTED, RED, SHEAR, TILE
from .threads import parallel

LOW_PASS_PX2 = np.float32(0.3)
"""Added to the projected covariance's diagonal, px²: no splat is narrower than a pixel."""
NEAR_M = np.float32(0.01)
SUM_BLOCK_SPLATS = 64
"""Splats whose pair gradients are summed at a time."""
QUATERNION_LIFT = np.float32(2.0**90)
ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
SH_CONSTANTS = np.array(
    [
        0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396,
        0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277,
    ],
    np.float32,
)  # fmt: skip
"""The normalization constants of the real spherical harmonics up to degree 3, in order of first use."""


@part_jit
def _rotation(q0, q1, q2, q3):
    """Rotation matrix entries of a unit quaternion wxyz."""
    return (
        ONE - TWO * (q2 * q2 + q3 * q3), TWO * (q1 * q2 - q0 * q3), TWO * (q1 * q3 + q0 * q2),
        TWO * (q1 * q2 + q0 * q3), ONE - TWO * (q1 * q1 + q3 * q3), TWO * (q2 * q3 - q0 * q1),
        TWO * (q1 * q3 - q0 * q2), TWO * (q2 * q3 + q0 * q1), ONE - TWO * (q1 * q1 + q2 * q2),
    )  # fmt: skip


@part_jit
def _unit(q0, q1, q2, q3):
    """Unit quaternion and 1 / norm of a quaternion of any length; zero counts as the identity, with 1 / norm = 0.

    The squares of 1e-20 and 1e20 leave float32's range, so quaternions far from length one are first scaled by a
    power of two. 1 / norm only serves the gradient, whose square must stay in range too: it ends at 1e12.
    """
    size = abs(q0) + abs(q1) + abs(q2) + abs(q3)
    lift = QUATERNION_LIFT if size < np.float32(1e-12) else (ONE / QUATERNION_LIFT if size > np.float32(1e12) else ONE)
    q0, q1, q2, q3 = q0 * lift, q1 * lift, q2 * lift, q3 * lift
    rn = ONE / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    if size == ZERO:
        q0, q1, q2, q3, rn = ONE, ZERO, ZERO, ZERO, ONE
        lift = ZERO
    return q0 * rn, q1 * rn, q2 * rn, q3 * rn, min(rn * lift, np.float32(1e12))


@part_jit
def _camera_point(matrix, origin, f, xyz, i):
    """Splat i, which lies on triangle f, in camera space."""
    lx, ly, lz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
    return (
        matrix[f, 0, 0] * lx + matrix[f, 0, 1] * ly + matrix[f, 0, 2] * lz + origin[f, 0],
        matrix[f, 1, 0] * lx + matrix[f, 1, 1] * ly + matrix[f, 1, 2] * lz + origin[f, 1],
        matrix[f, 2, 0] * lx + matrix[f, 2, 1] * ly + matrix[f, 2, 2] * lz + origin[f, 2],
    )


@part_jit
def _pixels_per_local(matrix, f, jx, jy, tx, ty):
    """The affine map U from triangle f's local frame to pixels, row by row: the projection's Jacobian times `matrix`.

    jx, jy: focal lengths over depth; tx, ty: x and y over depth.
    """
    return (
        jx * (matrix[f, 0, 0] - tx * matrix[f, 2, 0]), jx * (matrix[f, 0, 1] - tx * matrix[f, 2, 1]),
        jx * (matrix[f, 0, 2] - tx * matrix[f, 2, 2]),
        jy * (matrix[f, 1, 0] - ty * matrix[f, 2, 0]), jy * (matrix[f, 1, 1] - ty * matrix[f, 2, 1]),
        jy * (matrix[f, 1, 2] - ty * matrix[f, 2, 2]),
    )  # fmt: skip


@part_jit
def _row_times_matrix(a0, a1, a2, r00, r01, r02, r10, r11, r12, r20, r21, r22):
    return a0 * r00 + a1 * r10 + a2 * r20, a0 * r01 + a1 * r11 + a2 * r21, a0 * r02 + a1 * r12 + a2 * r22


@part_jit
def _view_direction(to_world, x, y, z):
    """Unit vector in world space from the camera to (x, y, z) in camera space, and 1 / distance."""
    rd = ONE / math.sqrt(x * x + y * y + z * z)
    return (
        (to_world[0, 0] * x + to_world[0, 1] * y + to_world[0, 2] * z) * rd,
        (to_world[1, 0] * x + to_world[1, 1] * y + to_world[1, 2] * z) * rd,
        (to_world[2, 0] * x + to_world[2, 1] * y + to_world[2, 2] * z) * rd,
        rd,
    )


@part_jit
def _basis(degree, x, y, z, b):
    """Real spherical harmonics of the unit direction (x, y, z), written to b (16,)."""
    b[0] = SH_CONSTANTS[0]
    if degree > 0:
        b[1], b[2], b[3] = -SH_CONSTANTS[1] * y, SH_CONSTANTS[1] * z, -SH_CONSTANTS[1] * x
    if degree > 1:
        b[4], b[5] = SH_CONSTANTS[2] * x * y, -SH_CONSTANTS[2] * y * z
        b[6] = SH_CONSTANTS[3] * (TWO * z * z - x * x - y * y)
        b[7], b[8] = -SH_CONSTANTS[2] * x * z, SH_CONSTANTS[4] * (x * x - y * y)
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        three, four = np.float32(3.0), np.float32(4.0)
        b[9] = -SH_CONSTANTS[5] * y * (three * xx - yy)
        b[10] = SH_CONSTANTS[6] * x * y * z
        b[11] = -SH_CONSTANTS[7] * y * (four * zz - xx - yy)
        b[12] = SH_CONSTANTS[8] * z * (TWO * zz - three * xx - three * yy)
        b[13] = -SH_CONSTANTS[7] * x * (four * zz - xx - yy)
        b[14] = SH_CONSTANTS[9] * z * (xx - yy)
        b[15] = -SH_CONSTANTS[5] * x * (xx - three * yy)


@part_jit
def _basis_gradient(degree, x, y, z, w):
    """Gradient with respect to (x, y, z) of Σ w[k]·basis[k], for w (16,)."""
    gx, gy, gz = ZERO, ZERO, ZERO
    if degree > 0:
        gx, gy, gz = -SH_CONSTANTS[1] * w[3], -SH_CONSTANTS[1] * w[1], SH_CONSTANTS[1] * w[2]
    if degree > 1:
        gx += (
            SH_CONSTANTS[2] * (y * w[4] - z * w[7])
            - TWO * SH_CONSTANTS[3] * x * w[6]
            + TWO * SH_CONSTANTS[4] * x * w[8]
        )
        gy += (
            SH_CONSTANTS[2] * (x * w[4] - z * w[5])
            - TWO * SH_CONSTANTS[3] * y * w[6]
            - TWO * SH_CONSTANTS[4] * y * w[8]
        )
        gz += -SH_CONSTANTS[2] * (y * w[5] + x * w[7]) + np.float32(4.0) * SH_CONSTANTS[3] * z * w[6]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        three, four, six, eight = np.float32(3.0), np.float32(4.0), np.float32(6.0), np.float32(8.0)
        gx += (
            -SH_CONSTANTS[5] * six * x * y * w[9]
            + SH_CONSTANTS[6] * y * z * w[10]
            + SH_CONSTANTS[7] * TWO * x * y * w[11]
        )
        gx += -SH_CONSTANTS[8] * six * x * z * w[12] - SH_CONSTANTS[7] * (four * zz - three * xx - yy) * w[13]
        gx += SH_CONSTANTS[9] * TWO * x * z * w[14] - SH_CONSTANTS[5] * three * (xx - yy) * w[15]
        gy += -SH_CONSTANTS[5] * three * (xx - yy) * w[9] + SH_CONSTANTS[6] * x * z * w[10]
        gy += -SH_CONSTANTS[7] * (four * zz - xx - three * yy) * w[11] - SH_CONSTANTS[8] * six * y * z * w[12]
        gy += (
            SH_CONSTANTS[7] * TWO * x * y * w[13]
            - SH_CONSTANTS[9] * TWO * y * z * w[14]
            + SH_CONSTANTS[5] * six * x * y * w[15]
        )
        gz += SH_CONSTANTS[6] * x * y * w[10] - SH_CONSTANTS[7] * eight * y * z * w[11]
        gz += SH_CONSTANTS[8] * (six * zz - three * xx - three * yy) * w[12] - SH_CONSTANTS[7] * eight * x * z * w[13]
        gz += SH_CONSTANTS[9] * (xx - yy) * w[14]
    return gx, gy, gz


@parallel(lambda origin, *_: len(origin))
@jit
def compose_frames(begin, end, origin, rotation, scale, turn, shift, camera_origin, camera_matrix):
    """Face frames as a camera sees them: camera_matrix = turn @ rotation · scale, camera_origin = turn @ origin +
    shift.

    origin (F, 3), rotation (F, 3, 3), scale (F,), turn (3, 3) and shift (3,) float64, so that distance from the origin
    costs no precision. Writes camera_origin (F, 3) and camera_matrix (F, 3, 3) float32.
    """
    for f in range(begin, end):
        for r in range(3):
            t0, t1, t2 = turn[r, 0], turn[r, 1], turn[r, 2]
            camera_origin[f, r] = t0 * origin[f, 0] + t1 * origin[f, 1] + t2 * origin[f, 2] + shift[r]
            for c in range(3):
                along = t0 * rotation[f, 0, c] + t1 * rotation[f, 1, c] + t2 * rotation[f, 2, c]
                camera_matrix[f, r, c] = scale[f] * along


@parallel(lambda rows, *_: len(rows))
@jit
def project_forward(
    begin, end, rows, rendered, splats, face, frames, degree, depth_as_color, antialiased, projection
):  # fmt: skip
    """Write the listed rows of `projection`; the tuples are those of `layout.py`.

    rows (M,): the splats to project. rendered (tiles_y, tiles_x) bool: a splat that reaches none of these tiles counts
    as not visible. face (N,) int32. degree: of the spherical harmonics used, at most the stored one. Colors follow as
    many components of strain as both the frames and the splats have.
    depth_as_color: blend (depth, 0, 0) instead of the color. antialiased: what LOW_PASS_PX2 adds to a splat's area is
    taken from its opacity (Mip-Splatting's 2D filter, gsplat's "antialiased" mode).
    """
    xyz, rotation, log_scale, opacity = splats.xyz, splats.rotation, splats.log_scale, splats.opacity
    sh, strain_color = splats.sh, splats.strain_color
    origin, matrix, strain, to_world = frames.origin, frames.matrix, frames.strain, frames.to_world
    projected, depth, extent_y, rect = projection.columns, projection.depth, projection.extent_y, projection.rect
    fx, fy, cx, cy = frames.intrinsics[0], frames.intrinsics[1], frames.intrinsics[2], frames.intrinsics[3]
    strains = min(strain.shape[1], strain_color.shape[1])
    width, height = frames.size[0], frames.size[1]
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    low_x, high_x, low_y, high_y = _tan_limits(fx, fy, cx, cy, width, height)
    basis = np.empty(16, np.float32)
    for n in range(begin, end):
        i = rows[n]
        rect[i, 0] = rect[i, 1] = rect[i, 2] = rect[i, 3] = 0
        f = face[i]
        x, y, z = _camera_point(matrix, origin, f, xyz, i)
        if z < NEAR_M:
            continue
        rz = ONE / z
        tx, ty = min(high_x, max(low_x, x * rz)), min(high_y, max(low_y, y * rz))
        q0, q1, q2, q3, _ = _unit(rotation[i, 0], rotation[i, 1], rotation[i, 2], rotation[i, 3])
        turn = _rotation(q0, q1, q2, q3)
        u00, u01, u02, u10, u11, u12 = _pixels_per_local(matrix, f, fx * rz, fy * rz, tx, ty)
        s0, s1, s2 = math.exp(log_scale[i, 0]), math.exp(log_scale[i, 1]), math.exp(log_scale[i, 2])
        w00, w01, w02 = _row_times_matrix(u00, u01, u02, *turn)
        w10, w11, w12 = _row_times_matrix(u10, u11, u12, *turn)
        a00, a01, a02, a10, a11, a12 = w00 * s0, w01 * s1, w02 * s2, w10 * s0, w11 * s1, w12 * s2
        xx = a00 * a00 + a01 * a01 + a02 * a02 + LOW_PASS_PX2
        xy = a00 * a10 + a01 * a11 + a02 * a12
        yy = a10 * a10 + a11 * a11 + a12 * a12 + LOW_PASS_PX2
        # det of A·Aᵀ + low·I as squared 2×2 minors plus positive terms: never cancels to zero or below.
        m01, m02, m12 = a00 * a11 - a01 * a10, a00 * a12 - a02 * a10, a01 * a12 - a02 * a11
        sharp = m01 * m01 + m02 * m02 + m12 * m12
        det = sharp + LOW_PASS_PX2 * (xx + yy - LOW_PASS_PX2)
        visible = ONE / (ONE + math.exp(-opacity[i]))
        if antialiased:
            visible *= math.sqrt(sharp / det)
        reach = TWO * math.log(np.float32(255.0) * visible)
        mean_x, mean_y = fx * x * rz + cx, fy * y * rz + cy
        if not (visible >= ZERO and det < np.inf and abs(mean_x) < np.inf and abs(mean_y) < np.inf):
            rect[i, 0] = rect[i, 1] = rect[i, 2] = rect[i, 3] = -1
            continue
        if reach <= ZERO:
            continue
        ex, ey = math.sqrt(reach * xx), math.sqrt(reach * yy)
        limit_x, limit_y = np.float32(tiles_x), np.float32(tiles_y)
        size_ = np.float32(TILE)
        x0 = np.int32(min(limit_x, max(ZERO, np.floor((mean_x - ex) / size_))))
        x1 = np.int32(min(limit_x, max(ZERO, np.ceil((mean_x + ex) / size_))))
        y0 = np.int32(min(limit_y, max(ZERO, np.floor((mean_y - ey) / size_))))
        y1 = np.int32(min(limit_y, max(ZERO, np.ceil((mean_y + ey) / size_))))
        if not _any_rendered(rendered, x0, y0, x1, y1):
            continue
        dx, dy, dz, _ = _view_direction(to_world, x, y, z)
        _basis(degree, dx, dy, dz, basis)
        red = green = blue = HALF
        for k in range((degree + 1) * (degree + 1)):
            red += basis[k] * sh[i, k, 0]
            green += basis[k] * sh[i, k, 1]
            blue += basis[k] * sh[i, k, 2]
        for k in range(strains):
            red += strain[f, k] * strain_color[i, k, 0]
            green += strain[f, k] * strain_color[i, k, 1]
            blue += strain[f, k] * strain_color[i, k, 2]
        # Before the cut at zero, which would turn NaN and −∞ into black.
        if not (abs(red) < np.inf and abs(green) < np.inf and abs(blue) < np.inf):
            rect[i, 0] = rect[i, 1] = rect[i, 2] = rect[i, 3] = -1
            continue
        red, green, blue = max(ZERO, red), max(ZERO, green), max(ZERO, blue)
        if depth_as_color:
            red, green, blue = z, ZERO, ZERO
        rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3] = x0, y0, x1, y1
        depth[i] = z
        extent_y[i] = ey
        projected[i, MEAN_X], projected[i, MEAN_Y] = mean_x, mean_y
        projected[i, PRECISION_X], projected[i, SHEAR], projected[i, PRECISION_Y] = yy / det, xy / yy, ONE / yy
        projected[i, OPACITY] = visible
        projected[i, RED], projected[i, GREEN], projected[i, BLUE] = red, green, blue


@part_jit
def _any_rendered(rendered, x0, y0, x1, y1):
    for y in range(y0, y1):
        for x in range(x0, x1):
            if rendered[y, x]:
                return True
    return False


@part_jit
def _tan_limits(fx, fy, cx, cy, width, height):
    """Bounds of x/z and y/z in the projection's Jacobian: the image plus 0.3 of its half field of view."""
    half_x, half_y = HALF * np.float32(width) / fx, HALF * np.float32(height) / fy
    margin = np.float32(0.3)
    low_x, high_x = -cx / fx - margin * half_x, (np.float32(width) - cx) / fx + margin * half_x
    low_y, high_y = -cy / fy - margin * half_y, (np.float32(height) - cy) / fy + margin * half_y
    return low_x, high_x, low_y, high_y


@part_jit
def _compensation_gradient(v, a00, a01, a02, a10, a11, a12, m01, m02, m12):
    """Gradient with respect to A's two rows of v·ln sqrt(sharp / det), as in `project_forward`."""
    low = LOW_PASS_PX2
    sharp = m01 * m01 + m02 * m02 + m12 * m12
    xx, yy = a00 * a00 + a01 * a01 + a02 * a02, a10 * a10 + a11 * a11 + a12 * a12
    det = sharp + low * (xx + yy + low)
    # v holds sqrt(sharp) as a factor, so the quotient stays finite where a splat has no area and v = 0.
    w = v * low * (xx + yy + low) / (det * max(sharp, np.float32(1e-30)))
    u = -v * low / det
    return (
        w * (m01 * a11 + m02 * a12) + u * a00, w * (-m01 * a10 + m12 * a12) + u * a01,
        w * (-m02 * a10 - m12 * a11) + u * a02, w * (-m01 * a01 - m02 * a02) + u * a10,
        w * (m01 * a00 - m12 * a02) + u * a11, w * (m02 * a00 + m12 * a01) + u * a12,
    )  # fmt: skip


@part_jit
def _sum_pairs(splats, lists, pair_gradients, sums):
    """Sum the gradients of each splat's pairs to sums (SUM_BLOCK_SPLATS, 9): a short loop asks memory for many of them
    at once."""
    first_pair, pairs, splat_pairs, grads = lists.first_pair, lists.pairs, lists.splat_pairs, pair_gradients
    for n in range(len(splats)):
        i = splats[n]
        g0 = g1 = g2 = g3 = g4 = g5 = g6 = g7 = g8 = ZERO
        for k in range(first_pair[i], first_pair[i] + pairs[i]):
            j = splat_pairs[k]
            g0, g1, g2 = g0 + grads[j, 0], g1 + grads[j, 1], g2 + grads[j, 2]
            g3, g4, g5 = g3 + grads[j, 3], g4 + grads[j, 4], g5 + grads[j, 5]
            g6, g7, g8 = g6 + grads[j, 6], g7 + grads[j, 7], g8 + grads[j, 8]
        sums[n, 0], sums[n, 1], sums[n, 2], sums[n, 3], sums[n, 4] = g0, g1, g2, g3, g4
        sums[n, 5], sums[n, 6], sums[n, 7], sums[n, 8] = g5, g6, g7, g8


@parallel(lambda visible, *_: len(visible))
@jit
def project_backward(
    begin, end, visible, splats, face, frames, degree, depth_as_color, antialiased,
    projected, lists, pair_gradients, gradients, screen_gradient,
):  # fmt: skip
    """Write the gradient of each listed splat to its row of `gradients`; the counterpart of `project_forward`.

    visible (M,) int32: the splats to differentiate. projected (N, PROJECTED): the columns of the projection.
    pair_gradients (P, PROJECTED). Writes screen_gradient (N,) too: the length of the gradient with respect to the
    projected center in units of half the image, for density control.
    """
    xyz, rotation, log_scale, opacity = splats.xyz, splats.rotation, splats.log_scale, splats.opacity
    sh, strain_color = splats.sh, splats.strain_color
    v_xyz, v_rotation, v_log_scale = gradients.xyz, gradients.rotation, gradients.log_scale
    v_opacity, v_sh, v_strain_color = gradients.opacity, gradients.sh, gradients.strain_color
    origin, matrix, strain, to_world = frames.origin, frames.matrix, frames.strain, frames.to_world
    fx, fy, cx, cy = frames.intrinsics[0], frames.intrinsics[1], frames.intrinsics[2], frames.intrinsics[3]
    size = frames.size
    strains = min(strain.shape[1], strain_color.shape[1])
    low_x, high_x, low_y, high_y = _tan_limits(fx, fy, cx, cy, size[0], size[1])
    basis, weight = np.empty(16, np.float32), np.empty(16, np.float32)
    sums = np.empty((SUM_BLOCK_SPLATS, PROJECTED), np.float32)
    for n in range(begin, end):
        i = visible[n]
        if (n - begin) % SUM_BLOCK_SPLATS == 0:
            _sum_pairs(visible[n : min(end, n + SUM_BLOCK_SPLATS)], lists, pair_gradients, sums)
        g = sums[(n - begin) % SUM_BLOCK_SPLATS]
        v_strain_color[i, :, :] = ZERO
        half_x, half_y = HALF * np.float32(size[0]) * g[MEAN_X], HALF * np.float32(size[1]) * g[MEAN_Y]
        screen_gradient[i] = math.sqrt(half_x * half_x + half_y * half_y)
        f = face[i]
        x, y, z = _camera_point(matrix, origin, f, xyz, i)
        rz = ONE / z
        slope_x, slope_y = x * rz, y * rz
        tx, ty = min(high_x, max(low_x, slope_x)), min(high_y, max(low_y, slope_y))
        q0, q1, q2, q3, rn = _unit(rotation[i, 0], rotation[i, 1], rotation[i, 2], rotation[i, 3])
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(q0, q1, q2, q3)
        jx, jy = fx * rz, fy * rz
        u00, u01, u02, u10, u11, u12 = _pixels_per_local(matrix, f, jx, jy, tx, ty)
        s0, s1, s2 = math.exp(log_scale[i, 0]), math.exp(log_scale[i, 1]), math.exp(log_scale[i, 2])
        w00, w01, w02 = _row_times_matrix(u00, u01, u02, r00, r01, r02, r10, r11, r12, r20, r21, r22)
        w10, w11, w12 = _row_times_matrix(u10, u11, u12, r00, r01, r02, r10, r11, r12, r20, r21, r22)
        a00, a01, a02, a10, a11, a12 = w00 * s0, w01 * s1, w02 * s2, w10 * s0, w11 * s1, w12 * s2

        # The x precision is 1 / s, s = xx − shear·xy. With rows a0, a1 of A and the residual e = a0 − shear·a1,
        # ds = 2·e·(da0 − shear·da1) and dshear = (a1·(da0 − shear·da1) + e·da1) / yy: the gradient with respect to
        # a0 is v0, that with respect to a1 is −shear·v0 + v1. The residual, and every product of −shear·v0 with
        # something of row 1, is taken together with row 0, because the two cancel for long splats.
        shear, inverse_yy = projected[i, SHEAR], projected[i, PRECISION_Y]
        m01, m02, m12 = a00 * a11 - a01 * a10, a00 * a12 - a02 * a10, a01 * a12 - a02 * a11
        e0 = inverse_yy * (LOW_PASS_PX2 * a00 + a11 * m01 + a12 * m02)
        e1 = inverse_yy * (LOW_PASS_PX2 * a01 - a10 * m01 + a12 * m12)
        e2 = inverse_yy * (LOW_PASS_PX2 * a02 - a10 * m02 - a11 * m12)
        vs = -TWO * projected[i, PRECISION_X] * projected[i, PRECISION_X] * g[PRECISION_X]
        vk = inverse_yy * g[SHEAR]
        vw = -TWO * inverse_yy * inverse_yy * g[PRECISION_Y]
        v00, v01, v02 = vs * e0 + vk * a10, vs * e1 + vk * a11, vs * e2 + vk * a12
        v10, v11, v12 = vk * e0 + vw * a10, vk * e1 + vw * a11, vk * e2 + vw * a12
        if antialiased:
            b00, b01, b02, b10, b11, b12 = _compensation_gradient(
                g[OPACITY] * projected[i, OPACITY], a00, a01, a02, a10, a11, a12, m01, m02, m12
            )
            v00, v01, v02 = v00 + b00, v01 + b01, v02 + b02
            v10, v11, v12 = v10 + b10 + shear * b00, v11 + b11 + shear * b01, v12 + b12 + shear * b02
        by0, by1, by2 = v00 * e0 + v10 * a10, v01 * e1 + v11 * a11, v02 * e2 + v12 * a12
        v_log_scale[i, 0] = by0
        v_log_scale[i, 1] = by1
        v_log_scale[i, 2] = by2
        # A = U·R·diag(s): to R, then through the normalized quaternion.
        v00, v01, v02, v10, v11, v12 = v00 * s0, v01 * s1, v02 * s2, v10 * s0, v11 * s1, v12 * s2
        p0, p1, p2 = u00 - shear * u10, u01 - shear * u11, u02 - shear * u12
        h00, h01, h02 = p0 * v00 + u10 * v10, p0 * v01 + u10 * v11, p0 * v02 + u10 * v12
        h10, h11, h12 = p1 * v00 + u11 * v10, p1 * v01 + u11 * v11, p1 * v02 + u11 * v12
        h20, h21, h22 = p2 * v00 + u12 * v10, p2 * v01 + u12 * v11, p2 * v02 + u12 * v12
        vq0 = TWO * (q3 * (h10 - h01) + q2 * (h02 - h20) + q1 * (h21 - h12))
        vq1 = TWO * (q2 * (h01 + h10) + q3 * (h02 + h20) + q0 * (h21 - h12) - TWO * q1 * (h11 + h22))
        vq2 = TWO * (q1 * (h01 + h10) + q3 * (h12 + h21) + q0 * (h02 - h20) - TWO * q2 * (h00 + h22))
        vq3 = TWO * (q1 * (h02 + h20) + q2 * (h12 + h21) + q0 * (h10 - h01) - TWO * q3 * (h00 + h11))
        radial = vq0 * q0 + vq1 * q1 + vq2 * q2 + vq3 * q3
        v_rotation[i, 0] = (vq0 - radial * q0) * rn
        v_rotation[i, 1] = (vq1 - radial * q1) * rn
        v_rotation[i, 2] = (vq2 - radial * q2) * rn
        v_rotation[i, 3] = (vq3 - radial * q3) * rn
        # to U, and through it to the camera-space position (the Jacobian depends on it).
        d00, d01 = v00 * r00 + v01 * r01 + v02 * r02, v00 * r10 + v01 * r11 + v02 * r12
        d02 = v00 * r20 + v01 * r21 + v02 * r22
        d10, d11 = v10 * r00 + v11 * r01 + v12 * r02, v10 * r10 + v11 * r11 + v12 * r12
        d12 = v10 * r20 + v11 * r21 + v12 * r22
        c20, c21, c22 = matrix[f, 2, 0], matrix[f, 2, 1], matrix[f, 2, 2]
        from_row_0 = d00 * c20 + d01 * c21 + d02 * c22
        vtx = -jx * from_row_0
        vty = -jy * (d10 * c20 + d11 * c21 + d12 * c22 - shear * from_row_0)
        vz = -rz * (by0 + by1 + by2)  # U shrinks with z as the scales do
        vtx = vtx if tx == slope_x else ZERO
        vty = vty if ty == slope_y else ZERO
        vtx, vty = vtx + g[MEAN_X] * fx, vty + g[MEAN_Y] * fy
        vx, vy = vtx * rz, vty * rz
        vz -= (vtx * slope_x + vty * slope_y) * rz

        # σ(−x) instead of 1 − σ(x), which cancels for nearly opaque splats.
        v_opacity[i] = g[OPACITY] * projected[i, OPACITY] / (ONE + math.exp(opacity[i]))
        if depth_as_color:
            v_sh[i, :, :] = ZERO
            vz += g[RED]
        else:
            dx, dy, dz, rd = _view_direction(to_world, x, y, z)
            _basis(degree, dx, dy, dz, basis)
            gr = g[RED] if projected[i, RED] > ZERO else ZERO
            gg = g[GREEN] if projected[i, GREEN] > ZERO else ZERO
            gb = g[BLUE] if projected[i, BLUE] > ZERO else ZERO
            for k in range((degree + 1) * (degree + 1)):
                v_sh[i, k, 0], v_sh[i, k, 1], v_sh[i, k, 2] = basis[k] * gr, basis[k] * gg, basis[k] * gb
                weight[k] = gr * sh[i, k, 0] + gg * sh[i, k, 1] + gb * sh[i, k, 2]
            v_sh[i, (degree + 1) * (degree + 1) :, :] = ZERO
            for k in range(strains):
                v_strain_color[i, k, 0] += strain[f, k] * gr
                v_strain_color[i, k, 1] += strain[f, k] * gg
                v_strain_color[i, k, 2] += strain[f, k] * gb
            ex, ey, ez = _basis_gradient(degree, dx, dy, dz, weight)
            along = ex * dx + ey * dy + ez * dz
            ex, ey, ez = (ex - along * dx) * rd, (ey - along * dy) * rd, (ez - along * dz) * rd
            vx += to_world[0, 0] * ex + to_world[1, 0] * ey + to_world[2, 0] * ez
            vy += to_world[0, 1] * ex + to_world[1, 1] * ey + to_world[2, 1] * ez
            vz += to_world[0, 2] * ex + to_world[1, 2] * ey + to_world[2, 2] * ez
        for c in range(3):
            v_xyz[i, c] = matrix[f, 0, c] * vx + matrix[f, 1, c] * vy + matrix[f, 2, c] * vz
