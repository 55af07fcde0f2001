"""Embedding, projection and colour of every splat in one pass, forward and backward.

The face frames arrive already in camera space (composed in float64 by the caller), so a head far from the
world's origin loses nothing to float32, and embedded and world-space splats take the same path.
"""

import math

import numpy as np
from numba import prange

from . import inline_jit, parallel_jit
from .blend import BLUE, CONIC_A, CONIC_B, CONIC_C, GREEN, MEAN_X, MEAN_Y, OPACITY, PROJECTED, RED, TILE

LOW_PASS = np.float32(0.3)
"""Added to the projected covariance's diagonal, px²: no splat is narrower than a pixel."""
NEAR = np.float32(0.01)
ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
SH = np.array(
    [
        0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396,
        0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277,
    ],
    np.float32,
)  # fmt: skip
"""The normalisation constants of the real spherical harmonics up to degree 3, in order of first use."""


@inline_jit
def _rotation(q0, q1, q2, q3):
    """Rotation matrix entries of a unit quaternion wxyz."""
    return (
        ONE - TWO * (q2 * q2 + q3 * q3), TWO * (q1 * q2 - q0 * q3), TWO * (q1 * q3 + q0 * q2),
        TWO * (q1 * q2 + q0 * q3), ONE - TWO * (q1 * q1 + q3 * q3), TWO * (q2 * q3 - q0 * q1),
        TWO * (q1 * q3 - q0 * q2), TWO * (q2 * q3 + q0 * q1), ONE - TWO * (q1 * q1 + q2 * q2),
    )  # fmt: skip


@inline_jit
def _basis(degree, x, y, z, b):
    """Real spherical harmonics of the unit direction (x, y, z), written to b (16,)."""
    b[0] = SH[0]
    if degree > 0:
        b[1], b[2], b[3] = -SH[1] * y, SH[1] * z, -SH[1] * x
    if degree > 1:
        b[4], b[5] = SH[2] * x * y, -SH[2] * y * z
        b[6] = SH[3] * (TWO * z * z - x * x - y * y)
        b[7], b[8] = -SH[2] * x * z, SH[4] * (x * x - y * y)
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        three, four = np.float32(3.0), np.float32(4.0)
        b[9] = -SH[5] * y * (three * xx - yy)
        b[10] = SH[6] * x * y * z
        b[11] = -SH[7] * y * (four * zz - xx - yy)
        b[12] = SH[8] * z * (TWO * zz - three * xx - three * yy)
        b[13] = -SH[7] * x * (four * zz - xx - yy)
        b[14] = SH[9] * z * (xx - yy)
        b[15] = -SH[5] * x * (xx - three * yy)


@inline_jit
def _basis_gradient(degree, x, y, z, w):
    """Gradient with respect to (x, y, z) of Σ w[k]·basis[k], for w (16,)."""
    gx, gy, gz = ZERO, ZERO, ZERO
    if degree > 0:
        gx, gy, gz = -SH[1] * w[3], -SH[1] * w[1], SH[1] * w[2]
    if degree > 1:
        gx += SH[2] * (y * w[4] - z * w[7]) - TWO * SH[3] * x * w[6] + TWO * SH[4] * x * w[8]
        gy += SH[2] * (x * w[4] - z * w[5]) - TWO * SH[3] * y * w[6] - TWO * SH[4] * y * w[8]
        gz += -SH[2] * (y * w[5] + x * w[7]) + np.float32(4.0) * SH[3] * z * w[6]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        three, four, six, eight = np.float32(3.0), np.float32(4.0), np.float32(6.0), np.float32(8.0)
        gx += -SH[5] * six * x * y * w[9] + SH[6] * y * z * w[10] + SH[7] * TWO * x * y * w[11]
        gx += -SH[8] * six * x * z * w[12] - SH[7] * (four * zz - three * xx - yy) * w[13]
        gx += SH[9] * TWO * x * z * w[14] - SH[5] * three * (xx - yy) * w[15]
        gy += -SH[5] * three * (xx - yy) * w[9] + SH[6] * x * z * w[10]
        gy += -SH[7] * (four * zz - xx - three * yy) * w[11] - SH[8] * six * y * z * w[12]
        gy += SH[7] * TWO * x * y * w[13] - SH[9] * TWO * y * z * w[14] + SH[5] * six * x * y * w[15]
        gz += SH[6] * x * y * w[10] - SH[7] * eight * y * z * w[11]
        gz += SH[8] * (six * zz - three * xx - three * yy) * w[12] - SH[7] * eight * x * z * w[13]
        gz += SH[9] * (xx - yy) * w[14]
    return gx, gy, gz


@parallel_jit
def project_forward(
    xyz, rotation, log_scale, opacity, sh, degree, face, origin, matrix, to_world, lens, size, depth_as_colour,
    projected, depth, extent_y, rect,
):  # fmt: skip
    """Project N embedded splats.

    xyz, rotation (wxyz), log_scale, opacity (logit), sh (N, K, 3), face: as in `Splats`; `degree` ≤ the stored.
    origin (F, 3), matrix (F, 3, 3): camera-space frames, scale included: camera point = matrix @ xyz + origin.
    to_world (3, 3): camera to world rotation. lens (4,): fl_x, fl_y, cx, cy. size (2,): width, height.
    depth_as_colour: blend (z, 0, 0) instead of the colour.
    Writes projected (N, 9), depth (N,), extent_y (N,) half height in pixels up to α = 1/255, and rect (N, 4) int32
    tile bounds x0, y0, x1, y1, empty (x1 ≤ x0) for a splat that cannot be seen or is not finite.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    width, height = size[0], size[1]
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    low_x, high_x, low_y, high_y = _tan_limits(fx, fy, cx, cy, width, height)
    chunk = 256
    for block in prange((len(xyz) + chunk - 1) // chunk):
        basis = np.empty(16, np.float32)
        for i in range(block * chunk, min(len(xyz), (block + 1) * chunk)):
            rect[i, 0] = rect[i, 1] = rect[i, 2] = rect[i, 3] = 0
            f = face[i]
            lx, ly, lz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            x = matrix[f, 0, 0] * lx + matrix[f, 0, 1] * ly + matrix[f, 0, 2] * lz + origin[f, 0]
            y = matrix[f, 1, 0] * lx + matrix[f, 1, 1] * ly + matrix[f, 1, 2] * lz + origin[f, 1]
            z = matrix[f, 2, 0] * lx + matrix[f, 2, 1] * ly + matrix[f, 2, 2] * lz + origin[f, 2]
            if not z >= NEAR:
                continue
            rz = ONE / z
            tx, ty = min(high_x, max(low_x, x * rz)), min(high_y, max(low_y, y * rz))
            q0, q1, q2, q3 = rotation[i, 0], rotation[i, 1], rotation[i, 2], rotation[i, 3]
            norm = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
            rn = ONE / norm
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(q0 * rn, q1 * rn, q2 * rn, q3 * rn)
            # U = J · matrix, the affine map from the local frame to pixels.
            jx, jy = fx * rz, fy * rz
            u00 = jx * (matrix[f, 0, 0] - tx * matrix[f, 2, 0])
            u01 = jx * (matrix[f, 0, 1] - tx * matrix[f, 2, 1])
            u02 = jx * (matrix[f, 0, 2] - tx * matrix[f, 2, 2])
            u10 = jy * (matrix[f, 1, 0] - ty * matrix[f, 2, 0])
            u11 = jy * (matrix[f, 1, 1] - ty * matrix[f, 2, 1])
            u12 = jy * (matrix[f, 1, 2] - ty * matrix[f, 2, 2])
            s0, s1, s2 = math.exp(log_scale[i, 0]), math.exp(log_scale[i, 1]), math.exp(log_scale[i, 2])
            a00, a01 = (u00 * r00 + u01 * r10 + u02 * r20) * s0, (u00 * r01 + u01 * r11 + u02 * r21) * s1
            a02 = (u00 * r02 + u01 * r12 + u02 * r22) * s2
            a10, a11 = (u10 * r00 + u11 * r10 + u12 * r20) * s0, (u10 * r01 + u11 * r11 + u12 * r21) * s1
            a12 = (u10 * r02 + u11 * r12 + u12 * r22) * s2
            xx = a00 * a00 + a01 * a01 + a02 * a02 + LOW_PASS
            xy = a00 * a10 + a01 * a11 + a02 * a12
            yy = a10 * a10 + a11 * a11 + a12 * a12 + LOW_PASS
            # det of A·Aᵀ + low·I as squared 2×2 minors plus positive terms: never cancels to zero or below.
            m01, m02, m12 = a00 * a11 - a01 * a10, a00 * a12 - a02 * a10, a01 * a12 - a02 * a11
            det = m01 * m01 + m02 * m02 + m12 * m12 + LOW_PASS * (xx + yy - LOW_PASS)
            visible = ONE / (ONE + math.exp(-opacity[i]))
            reach = TWO * math.log(np.float32(255.0) * visible)
            mean_x, mean_y = fx * x * rz + cx, fy * y * rz + cy
            if not (reach > ZERO and det < np.inf and abs(mean_x) < np.inf and abs(mean_y) < np.inf):
                continue
            ex, ey = math.sqrt(reach * xx), math.sqrt(reach * yy)
            limit_x, limit_y = np.float32(tiles_x), np.float32(tiles_y)
            size_ = np.float32(TILE)
            x0 = np.int32(min(limit_x, max(ZERO, np.floor((mean_x - ex) / size_))))
            x1 = np.int32(min(limit_x, max(ZERO, np.ceil((mean_x + ex) / size_))))
            y0 = np.int32(min(limit_y, max(ZERO, np.floor((mean_y - ey) / size_))))
            y1 = np.int32(min(limit_y, max(ZERO, np.ceil((mean_y + ey) / size_))))
            if x1 <= x0 or y1 <= y0:
                continue
            red, green, blue = z, ZERO, ZERO
            if not depth_as_colour:
                rd = ONE / math.sqrt(x * x + y * y + z * z)
                dx = (to_world[0, 0] * x + to_world[0, 1] * y + to_world[0, 2] * z) * rd
                dy = (to_world[1, 0] * x + to_world[1, 1] * y + to_world[1, 2] * z) * rd
                dz = (to_world[2, 0] * x + to_world[2, 1] * y + to_world[2, 2] * z) * rd
                _basis(degree, dx, dy, dz, basis)
                red = green = blue = HALF
                for k in range((degree + 1) * (degree + 1)):
                    red += basis[k] * sh[i, k, 0]
                    green += basis[k] * sh[i, k, 1]
                    blue += basis[k] * sh[i, k, 2]
                red, green, blue = max(ZERO, red), max(ZERO, green), max(ZERO, blue)
                if not (red < np.inf and green < np.inf and blue < np.inf):
                    continue
            rect[i, 0], rect[i, 1], rect[i, 2], rect[i, 3] = x0, y0, x1, y1
            depth[i] = z
            extent_y[i] = ey
            projected[i, MEAN_X], projected[i, MEAN_Y] = mean_x, mean_y
            projected[i, CONIC_A], projected[i, CONIC_B], projected[i, CONIC_C] = yy / det, -xy / det, xx / det
            projected[i, OPACITY] = visible
            projected[i, RED], projected[i, GREEN], projected[i, BLUE] = red, green, blue


@inline_jit
def _tan_limits(fx, fy, cx, cy, width, height):
    """Bounds of x/z and y/z in the projection's Jacobian: the image plus 0.3 of its half field of view."""
    half_x, half_y = HALF * np.float32(width) / fx, HALF * np.float32(height) / fy
    margin = np.float32(0.3)
    low_x, high_x = -cx / fx - margin * half_x, (np.float32(width) - cx) / fx + margin * half_x
    low_y, high_y = -cy / fy - margin * half_y, (np.float32(height) - cy) / fy + margin * half_y
    return low_x, high_x, low_y, high_y


@parallel_jit
def project_backward(
    xyz, rotation, log_scale, opacity, sh, degree, face, origin, matrix, to_world, lens, size, depth_as_colour,
    projected, visible, slot_start, slot_count, grads, add,
    v_xyz, v_rotation, v_log_scale, v_opacity, v_sh, screen,
):  # fmt: skip
    """Write the gradient of each listed splat to its row of v_* (or add it); the counterpart of `project_forward`.

    visible (M,) int32: the splats to differentiate. slot_start, slot_count (N,) int32: where their pairs' gradients
    lie in grads (P, 9). screen (N,): length of the gradient with respect to the projected centre in units of half the
    image (what density control asks for), written for each listed splat.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    low_x, high_x, low_y, high_y = _tan_limits(fx, fy, cx, cy, size[0], size[1])
    chunk = 256
    for block in prange((len(visible) + chunk - 1) // chunk):
        basis, weight = np.empty(16, np.float32), np.empty(16, np.float32)
        g = np.empty(PROJECTED, np.float32)
        for n in range(block * chunk, min(len(visible), (block + 1) * chunk)):
            i = visible[n]
            if not add:
                v_xyz[i, :] = ZERO
                v_rotation[i, :] = ZERO
                v_log_scale[i, :] = ZERO
                v_opacity[i] = ZERO
                v_sh[i, :, :] = ZERO
            for c in range(PROJECTED):
                g[c] = ZERO
            for slot in range(slot_start[i], slot_start[i] + slot_count[i]):
                for c in range(PROJECTED):
                    g[c] += grads[slot, c]
            half_x, half_y = HALF * np.float32(size[0]) * g[MEAN_X], HALF * np.float32(size[1]) * g[MEAN_Y]
            screen[i] = math.sqrt(half_x * half_x + half_y * half_y)
            f = face[i]
            lx, ly, lz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            c00, c01, c02 = matrix[f, 0, 0], matrix[f, 0, 1], matrix[f, 0, 2]
            c10, c11, c12 = matrix[f, 1, 0], matrix[f, 1, 1], matrix[f, 1, 2]
            c20, c21, c22 = matrix[f, 2, 0], matrix[f, 2, 1], matrix[f, 2, 2]
            x = c00 * lx + c01 * ly + c02 * lz + origin[f, 0]
            y = c10 * lx + c11 * ly + c12 * lz + origin[f, 1]
            z = c20 * lx + c21 * ly + c22 * lz + origin[f, 2]
            rz = ONE / z
            slope_x, slope_y = x * rz, y * rz
            tx, ty = min(high_x, max(low_x, slope_x)), min(high_y, max(low_y, slope_y))
            q0, q1, q2, q3 = rotation[i, 0], rotation[i, 1], rotation[i, 2], rotation[i, 3]
            rn = ONE / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
            q0, q1, q2, q3 = q0 * rn, q1 * rn, q2 * rn, q3 * rn
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(q0, q1, q2, q3)
            jx, jy = fx * rz, fy * rz
            u00, u01, u02 = jx * (c00 - tx * c20), jx * (c01 - tx * c21), jx * (c02 - tx * c22)
            u10, u11, u12 = jy * (c10 - ty * c20), jy * (c11 - ty * c21), jy * (c12 - ty * c22)
            s0, s1, s2 = math.exp(log_scale[i, 0]), math.exp(log_scale[i, 1]), math.exp(log_scale[i, 2])
            w00, w01 = u00 * r00 + u01 * r10 + u02 * r20, u00 * r01 + u01 * r11 + u02 * r21
            w02 = u00 * r02 + u01 * r12 + u02 * r22
            w10, w11 = u10 * r00 + u11 * r10 + u12 * r20, u10 * r01 + u11 * r11 + u12 * r21
            w12 = u10 * r02 + u11 * r12 + u12 * r22
            a00, a01, a02, a10, a11, a12 = w00 * s0, w01 * s1, w02 * s2, w10 * s0, w11 * s1, w12 * s2

            # conic → covariance: V_cov = −conic · V_conic · conic, with V_conic's off-diagonal split in two.
            p, q, r = projected[i, CONIC_A], projected[i, CONIC_B], projected[i, CONIC_C]
            va, vb, vc = g[CONIC_A], HALF * g[CONIC_B], g[CONIC_C]
            e00, e01 = p * va + q * vb, p * vb + q * vc
            e10, e11 = q * va + r * vb, q * vb + r * vc
            vxx, vxy, vyy = -(e00 * p + e01 * q), -(e00 * q + e01 * r), -(e10 * q + e11 * r)
            # covariance = A·Aᵀ
            b00, b01, b02 = (
                TWO * (vxx * a00 + vxy * a10),
                TWO * (vxx * a01 + vxy * a11),
                TWO * (vxx * a02 + vxy * a12),
            )
            b10, b11, b12 = (
                TWO * (vxy * a00 + vyy * a10),
                TWO * (vxy * a01 + vyy * a11),
                TWO * (vxy * a02 + vyy * a12),
            )
            v_log_scale[i, 0] += b00 * a00 + b10 * a10
            v_log_scale[i, 1] += b01 * a01 + b11 * a11
            v_log_scale[i, 2] += b02 * a02 + b12 * a12
            # A = U·R·diag(s): to R, then through the normalised quaternion.
            b00, b01, b02, b10, b11, b12 = b00 * s0, b01 * s1, b02 * s2, b10 * s0, b11 * s1, b12 * s2
            h00, h01, h02 = u00 * b00 + u10 * b10, u00 * b01 + u10 * b11, u00 * b02 + u10 * b12
            h10, h11, h12 = u01 * b00 + u11 * b10, u01 * b01 + u11 * b11, u01 * b02 + u11 * b12
            h20, h21, h22 = u02 * b00 + u12 * b10, u02 * b01 + u12 * b11, u02 * b02 + u12 * b12
            vq0 = TWO * (q3 * (h10 - h01) + q2 * (h02 - h20) + q1 * (h21 - h12))
            vq1 = TWO * (q2 * (h01 + h10) + q3 * (h02 + h20) + q0 * (h21 - h12) - TWO * q1 * (h11 + h22))
            vq2 = TWO * (q1 * (h01 + h10) + q3 * (h12 + h21) + q0 * (h02 - h20) - TWO * q2 * (h00 + h22))
            vq3 = TWO * (q1 * (h02 + h20) + q2 * (h12 + h21) + q0 * (h10 - h01) - TWO * q3 * (h00 + h11))
            radial = vq0 * q0 + vq1 * q1 + vq2 * q2 + vq3 * q3
            v_rotation[i, 0] += (vq0 - radial * q0) * rn
            v_rotation[i, 1] += (vq1 - radial * q1) * rn
            v_rotation[i, 2] += (vq2 - radial * q2) * rn
            v_rotation[i, 3] += (vq3 - radial * q3) * rn
            # to U, and through it to the camera-space position (the Jacobian depends on it).
            d00, d01 = b00 * r00 + b01 * r01 + b02 * r02, b00 * r10 + b01 * r11 + b02 * r12
            d02 = b00 * r20 + b01 * r21 + b02 * r22
            d10, d11 = b10 * r00 + b11 * r01 + b12 * r02, b10 * r10 + b11 * r11 + b12 * r12
            d12 = b10 * r20 + b11 * r21 + b12 * r22
            vtx = -jx * (d00 * c20 + d01 * c21 + d02 * c22)
            vty = -jy * (d10 * c20 + d11 * c21 + d12 * c22)
            vz = -rz * (d00 * u00 + d01 * u01 + d02 * u02 + d10 * u10 + d11 * u11 + d12 * u12)
            vtx = vtx if tx == slope_x else ZERO
            vty = vty if ty == slope_y else ZERO
            vtx, vty = vtx + g[MEAN_X] * fx, vty + g[MEAN_Y] * fy
            vx, vy = vtx * rz, vty * rz
            vz -= (vtx * slope_x + vty * slope_y) * rz

            # σ(−x) instead of 1 − σ(x), which cancels for nearly opaque splats.
            v_opacity[i] += g[OPACITY] * projected[i, OPACITY] / (ONE + math.exp(opacity[i]))
            if depth_as_colour:
                vz += g[RED]
            else:
                rd = ONE / math.sqrt(x * x + y * y + z * z)
                dx = (to_world[0, 0] * x + to_world[0, 1] * y + to_world[0, 2] * z) * rd
                dy = (to_world[1, 0] * x + to_world[1, 1] * y + to_world[1, 2] * z) * rd
                dz = (to_world[2, 0] * x + to_world[2, 1] * y + to_world[2, 2] * z) * rd
                _basis(degree, dx, dy, dz, basis)
                gr = g[RED] if projected[i, RED] > ZERO else ZERO
                gg = g[GREEN] if projected[i, GREEN] > ZERO else ZERO
                gb = g[BLUE] if projected[i, BLUE] > ZERO else ZERO
                for k in range((degree + 1) * (degree + 1)):
                    v_sh[i, k, 0] += basis[k] * gr
                    v_sh[i, k, 1] += basis[k] * gg
                    v_sh[i, k, 2] += basis[k] * gb
                    weight[k] = gr * sh[i, k, 0] + gg * sh[i, k, 1] + gb * sh[i, k, 2]
                ex, ey, ez = _basis_gradient(degree, dx, dy, dz, weight)
                along = ex * dx + ey * dy + ez * dz
                ex, ey, ez = (ex - along * dx) * rd, (ey - along * dy) * rd, (ez - along * dz) * rd
                vx += to_world[0, 0] * ex + to_world[1, 0] * ey + to_world[2, 0] * ez
                vy += to_world[0, 1] * ex + to_world[1, 1] * ey + to_world[2, 1] * ez
                vz += to_world[0, 2] * ex + to_world[1, 2] * ey + to_world[2, 2] * ez
            v_xyz[i, 0] += c00 * vx + c10 * vy + c20 * vz
            v_xyz[i, 1] += c01 * vx + c11 * vy + c21 * vz
            v_xyz[i, 2] += c02 * vx + c12 * vy + c22 * vz
