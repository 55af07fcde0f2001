"""Embedding, projection and color of every splat, one thread each; the counterpart of `cpu/project.py`.

A splat's row is read and written by one thread: 59 floats in a row, so the cache lines it opens are used up.
"""

# A vector type made by Warp is a variable to mypy.
# mypy: disable-error-code="valid-type, index"

import warp as wp

from ..cpu import project as cpu
from ..cpu.layout import BLUE, GREEN, MEAN_X, MEAN_Y, OPACITY, PRECISION_X, PRECISION_Y, RED, SHEAR
from ..cpu.layout import PROJECTED as _PROJECTED
from ..cpu.layout import TILE as _TILE

wp.set_module_options({"enable_backward": False})  # gradients are kernels of their own

TILE = wp.constant(_TILE)
LOW_PASS_PX2, NEAR_M, QUATERNION_LIFT = (
    wp.constant(float(c)) for c in (cpu.LOW_PASS_PX2, cpu.NEAR_M, cpu.QUATERNION_LIFT)
)
S0, S1, S2, S3, S4, S5, S6, S7, S8, S9 = (wp.constant(float(c)) for c in cpu.SH_CONSTANTS)
BASIS = 16

Projected = wp.types.vector(length=_PROJECTED, dtype=wp.float32)
"""A projected splat, or the gradient of one (tile, splat) pair, with the columns of `cpu/layout.py`."""
Basis = wp.types.vector(length=BASIS, dtype=wp.float32)


@wp.struct
class DeviceCamera:
    """A camera: intrinsics and size in pixels, camera to world rotation, and rendering options."""

    fx: wp.float32
    fy: wp.float32
    cx: wp.float32
    cy: wp.float32
    width: wp.int32
    height: wp.int32
    tiles_x: wp.int32
    tiles_y: wp.int32
    to_world: wp.mat33
    degree: wp.int32
    strains: wp.int32  # how many columns of strain the colors follow
    depth_as_color: wp.bool
    antialiased: wp.bool


@wp.struct
class CameraSplat:
    """A splat in the camera: what forward and backward both need."""

    position: wp.vec3
    quaternion: wp.vec4
    inverse_norm: wp.float32
    turn: wp.mat33
    scale: wp.vec3
    slope: wp.vec2
    clamped: wp.vec2  # the slope within the frustum's limits
    u0: wp.vec3  # rows of the map from the local frame to pixels
    u1: wp.vec3
    a0: wp.vec3  # rows of A = U·R·diag(scale); the covariance is A·Aᵀ + LOW_PASS_PX2·I
    a1: wp.vec3
    minors: wp.vec3


@wp.func
def _unit(q: wp.vec4):
    """Unit quaternion and 1 / norm, as `cpu/project.py` takes them."""
    size = wp.abs(q[0]) + wp.abs(q[1]) + wp.abs(q[2]) + wp.abs(q[3])
    lift = wp.where(size < 1.0e-12, QUATERNION_LIFT, wp.where(size > 1.0e12, 1.0 / QUATERNION_LIFT, 1.0))
    q = q * lift
    inverse = 1.0 / wp.sqrt(wp.dot(q, q))
    if size == 0.0:
        return wp.vec4(1.0, 0.0, 0.0, 0.0), float(0.0)
    return q * inverse, wp.min(inverse * lift, 1.0e12)


@wp.func
def _rotation(q: wp.vec4) -> wp.mat33:
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def _clamp_slope(slope: float, size: float, focal: float, principal: float) -> float:
    """x/z or y/z, kept within the image plus 0.3 of its half field of view, for the projection's Jacobian."""
    margin = 0.3 * (0.5 * size / focal)
    return wp.min((size - principal) / focal + margin, wp.max(-principal / focal - margin, slope))


@wp.func
def _to_camera(
    xyz: wp.vec3, q: wp.vec4, log_scale: wp.vec3, origin: wp.vec3, frame: wp.mat33, lens: DeviceCamera
) -> CameraSplat:
    s = CameraSplat()
    s.position = frame * xyz + origin
    r = 1.0 / s.position[2]
    s.slope = wp.vec2(s.position[0] * r, s.position[1] * r)
    s.clamped = wp.vec2(
        _clamp_slope(s.slope[0], float(lens.width), lens.fx, lens.cx),
        _clamp_slope(s.slope[1], float(lens.height), lens.fy, lens.cy),
    )
    quaternion, inverse_norm = _unit(q)
    s.quaternion = quaternion
    s.inverse_norm = inverse_norm
    s.turn = _rotation(s.quaternion)
    s.scale = wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
    last = wp.vec3(frame[2, 0], frame[2, 1], frame[2, 2])
    s.u0 = lens.fx * r * (wp.vec3(frame[0, 0], frame[0, 1], frame[0, 2]) - s.clamped[0] * last)
    s.u1 = lens.fy * r * (wp.vec3(frame[1, 0], frame[1, 1], frame[1, 2]) - s.clamped[1] * last)
    back = wp.transpose(s.turn)
    s.a0 = wp.cw_mul(back * s.u0, s.scale)
    s.a1 = wp.cw_mul(back * s.u1, s.scale)
    s.minors = wp.cross(s.a0, s.a1)
    return s


@wp.func
def _basis(degree: int, d: wp.vec3) -> Basis:
    """Real spherical harmonics of a unit direction; those above the degree are zero."""
    b = Basis()
    x, y, z = d[0], d[1], d[2]
    xx, yy, zz = x * x, y * y, z * z
    b[0] = S0
    if degree > 0:
        b[1] = -S1 * y
        b[2] = S1 * z
        b[3] = -S1 * x
    if degree > 1:
        b[4] = S2 * x * y
        b[5] = -S2 * y * z
        b[6] = S3 * (2.0 * zz - xx - yy)
        b[7] = -S2 * x * z
        b[8] = S4 * (xx - yy)
    if degree > 2:
        b[9] = -S5 * y * (3.0 * xx - yy)
        b[10] = S6 * x * y * z
        b[11] = -S7 * y * (4.0 * zz - xx - yy)
        b[12] = S8 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
        b[13] = -S7 * x * (4.0 * zz - xx - yy)
        b[14] = S9 * z * (xx - yy)
        b[15] = -S5 * x * (xx - 3.0 * yy)
    return b


@wp.func
def _basis_gradient(degree: int, d: wp.vec3, w: Basis) -> wp.vec3:
    """Gradient with respect to the direction of Σ w[k]·basis[k]."""
    gx, gy, gz = float(0.0), float(0.0), float(0.0)
    x, y, z = d[0], d[1], d[2]
    if degree > 0:
        gx, gy, gz = -S1 * w[3], -S1 * w[1], S1 * w[2]
    if degree > 1:
        gx += S2 * (y * w[4] - z * w[7]) - 2.0 * S3 * x * w[6] + 2.0 * S4 * x * w[8]
        gy += S2 * (x * w[4] - z * w[5]) - 2.0 * S3 * y * w[6] - 2.0 * S4 * y * w[8]
        gz += -S2 * (y * w[5] + x * w[7]) + 4.0 * S3 * z * w[6]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        gx += -S5 * 6.0 * x * y * w[9] + S6 * y * z * w[10] + S7 * 2.0 * x * y * w[11]
        gx += -S8 * 6.0 * x * z * w[12] - S7 * (4.0 * zz - 3.0 * xx - yy) * w[13]
        gx += S9 * 2.0 * x * z * w[14] - S5 * 3.0 * (xx - yy) * w[15]
        gy += -S5 * 3.0 * (xx - yy) * w[9] + S6 * x * z * w[10]
        gy += -S7 * (4.0 * zz - xx - 3.0 * yy) * w[11] - S8 * 6.0 * y * z * w[12]
        gy += S7 * 2.0 * x * y * w[13] - S9 * 2.0 * y * z * w[14] + S5 * 6.0 * x * y * w[15]
        gz += S6 * x * y * w[10] - S7 * 8.0 * y * z * w[11]
        gz += S8 * (6.0 * zz - 3.0 * xx - 3.0 * yy) * w[12] - S7 * 8.0 * x * z * w[13]
        gz += S9 * (xx - yy) * w[14]
    return wp.vec3(gx, gy, gz)


@wp.func
def _finite(v: wp.vec3) -> bool:
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.func
def _tile(pixel: float, tiles: int) -> int:
    return int(wp.min(float(tiles), wp.max(0.0, pixel)))


@wp.kernel
def project_forward(
    xyz: wp.array[wp.vec3],
    rotation: wp.array[wp.vec4],
    log_scale: wp.array[wp.vec3],
    opacity: wp.array[wp.float32],
    sh: wp.array2d[wp.vec3],
    strain_color: wp.array2d[wp.vec3],
    face: wp.array[wp.int32],
    origin: wp.array[wp.vec3],
    matrix: wp.array[wp.mat33],
    strain: wp.array2d[wp.float32],
    lens: DeviceCamera,
    projected: wp.array[Projected],
    depth: wp.array[wp.float32],
    order: wp.array[wp.int32],
    rect: wp.array[wp.vec4i],
):
    """As the CPU's, except that depth and order (2·N,) are keys and values ready to be sorted: infinity where a splat
    cannot be seen, and the splat's own number."""
    i = wp.tid()
    depth[i] = wp.inf
    order[i] = i
    rect[i] = wp.vec4i(0, 0, 0, 0)
    f = face[i]
    # The near plane first: nothing below may divide by a depth of zero.
    if (matrix[f] * xyz[i] + origin[f])[2] < NEAR_M:
        return
    s = _to_camera(xyz[i], rotation[i], log_scale[i], origin[f], matrix[f], lens)
    xx, xy = wp.dot(s.a0, s.a0) + LOW_PASS_PX2, wp.dot(s.a0, s.a1)
    yy = wp.dot(s.a1, s.a1) + LOW_PASS_PX2
    # As squared 2×2 minors plus positive terms the determinant never cancels to zero or below.
    sharp = wp.dot(s.minors, s.minors)
    det = sharp + LOW_PASS_PX2 * (xx + yy - LOW_PASS_PX2)
    visible = 1.0 / (1.0 + wp.exp(-opacity[i]))
    if lens.antialiased:
        visible *= wp.sqrt(sharp / det)
    reach = 2.0 * wp.log(255.0 * visible)
    mean_x, mean_y = lens.fx * s.slope[0] + lens.cx, lens.fy * s.slope[1] + lens.cy
    if not (visible >= 0.0 and wp.isfinite(det) and wp.isfinite(mean_x) and wp.isfinite(mean_y)):
        rect[i] = wp.vec4i(-1, -1, -1, -1)
        return
    if reach <= 0.0:
        return
    ex, ey = wp.sqrt(reach * xx), wp.sqrt(reach * yy)
    size = float(TILE)
    x0, x1 = _tile(wp.floor((mean_x - ex) / size), lens.tiles_x), _tile(wp.ceil((mean_x + ex) / size), lens.tiles_x)
    y0, y1 = _tile(wp.floor((mean_y - ey) / size), lens.tiles_y), _tile(wp.ceil((mean_y + ey) / size), lens.tiles_y)
    if x1 <= x0 or y1 <= y0:
        return
    b = _basis(lens.degree, lens.to_world * (s.position / wp.length(s.position)))
    color = wp.vec3(0.5, 0.5, 0.5)
    for k in range(wp.static(BASIS)):
        if k < (lens.degree + 1) * (lens.degree + 1):
            color += b[k] * sh[i, k]
    for k in range(lens.strains):
        color += strain[f, k] * strain_color[i, k]
    # Before the cut at zero, which would turn NaN and −∞ into black.
    if not _finite(color):
        rect[i] = wp.vec4i(-1, -1, -1, -1)
        return
    color = wp.max(color, wp.vec3(0.0, 0.0, 0.0))
    if lens.depth_as_color:
        color = wp.vec3(s.position[2], 0.0, 0.0)
    rect[i] = wp.vec4i(x0, y0, x1, y1)
    depth[i] = s.position[2]
    projected[i] = Projected(
        mean_x, mean_y, yy / det, xy / yy, 1.0 / yy, visible, color[0], color[1], color[2]
    )  # fmt: skip


@wp.func
def _rotation_gradient(q: wp.vec4, h: wp.mat33) -> wp.vec4:
    """Gradient with respect to the unit quaternion, along its sphere, of that with respect to the matrix."""
    v = 2.0 * wp.vec4(
        q[3] * (h[1, 0] - h[0, 1]) + q[2] * (h[0, 2] - h[2, 0]) + q[1] * (h[2, 1] - h[1, 2]),
        q[2] * (h[0, 1] + h[1, 0]) + q[3] * (h[0, 2] + h[2, 0]) + q[0] * (h[2, 1] - h[1, 2])
        - 2.0 * q[1] * (h[1, 1] + h[2, 2]),
        q[1] * (h[0, 1] + h[1, 0]) + q[3] * (h[1, 2] + h[2, 1]) + q[0] * (h[0, 2] - h[2, 0])
        - 2.0 * q[2] * (h[0, 0] + h[2, 2]),
        q[1] * (h[0, 2] + h[2, 0]) + q[2] * (h[1, 2] + h[2, 1]) + q[0] * (h[1, 0] - h[0, 1])
        - 2.0 * q[3] * (h[0, 0] + h[1, 1]),
    )  # fmt: skip
    return v - wp.dot(v, q) * q


@wp.kernel
def project_backward(
    xyz: wp.array[wp.vec3],
    rotation: wp.array[wp.vec4],
    log_scale: wp.array[wp.vec3],
    opacity: wp.array[wp.float32],
    sh: wp.array2d[wp.vec3],
    strain_color: wp.array2d[wp.vec3],
    face: wp.array[wp.int32],
    origin: wp.array[wp.vec3],
    matrix: wp.array[wp.mat33],
    strain: wp.array2d[wp.float32],
    lens: DeviceCamera,
    projected: wp.array[Projected],
    wanted: wp.array[wp.uint8],
    slot_start: wp.array[wp.int32],
    slot_count: wp.array[wp.int32],
    parts: wp.int32,
    rows: wp.array[Projected],
    v_xyz: wp.array[wp.vec3],
    v_rotation: wp.array[wp.vec4],
    v_log_scale: wp.array[wp.vec3],
    v_opacity: wp.array[wp.float32],
    v_sh: wp.array2d[wp.vec3],
    v_strain_color: wp.array2d[wp.vec3],
    screen: wp.array[wp.float32],
):
    """Sum each wanted splat's rows, in order, and overwrite its gradient; all other splats' gradients stay.

    wanted (N,) 0 or 1; slot_start, slot_count (N,): the splat's slots, of `parts` rows each. screen (N,) as the CPU's.
    """
    i = wp.tid()
    if wanted[i] == wp.uint8(0):
        return
    g = Projected()
    begin = slot_start[i] * parts
    for row in range(begin, begin + slot_count[i] * parts):
        g += rows[row]
    half_x, half_y = 0.5 * float(lens.width) * g[MEAN_X], 0.5 * float(lens.height) * g[MEAN_Y]
    screen[i] = wp.sqrt(half_x * half_x + half_y * half_y)
    f = face[i]
    frame = matrix[f]
    s = _to_camera(xyz[i], rotation[i], log_scale[i], origin[f], frame, lens)
    p = projected[i]

    # The derivation, and what must be taken together because it cancels, stands in `cpu/project.py`.
    shear, inverse_yy = p[SHEAR], p[PRECISION_Y]
    e = inverse_yy * (LOW_PASS_PX2 * s.a0 + wp.cross(s.a1, s.minors))
    vs = -2.0 * p[PRECISION_X] * p[PRECISION_X] * g[PRECISION_X]
    vk = inverse_yy * g[SHEAR]
    vw = -2.0 * inverse_yy * inverse_yy * g[PRECISION_Y]
    v0 = vs * e + vk * s.a1
    v1 = vk * e + vw * s.a1
    if lens.antialiased:
        sharp = wp.dot(s.minors, s.minors)
        around = LOW_PASS_PX2 * (wp.dot(s.a0, s.a0) + wp.dot(s.a1, s.a1) + LOW_PASS_PX2)
        v = g[OPACITY] * p[OPACITY]
        w = v * around / ((sharp + around) * wp.max(sharp, 1.0e-30))
        u = -v * LOW_PASS_PX2 / (sharp + around)
        b0 = w * wp.cross(s.a1, s.minors) + u * s.a0
        v0 += b0
        v1 += w * wp.cross(s.minors, s.a0) + u * s.a1 + shear * b0
    by = wp.cw_mul(v0, e) + wp.cw_mul(v1, s.a1)
    v_log_scale[i] = by
    v0, v1 = wp.cw_mul(v0, s.scale), wp.cw_mul(v1, s.scale)
    by_turn = wp.outer(s.u0 - shear * s.u1, v0) + wp.outer(s.u1, v1)
    v_rotation[i] = s.inverse_norm * _rotation_gradient(s.quaternion, by_turn)
    # To U, and through it to the camera-space position (the Jacobian depends on it).
    r = 1.0 / s.position[2]
    last = wp.vec3(frame[2, 0], frame[2, 1], frame[2, 2])
    from_row_0 = wp.dot(s.turn * v0, last)
    tx = -lens.fx * r * from_row_0
    ty = -lens.fy * r * (wp.dot(s.turn * v1, last) - shear * from_row_0)
    tx = wp.where(s.clamped[0] == s.slope[0], tx, 0.0) + g[MEAN_X] * lens.fx
    ty = wp.where(s.clamped[1] == s.slope[1], ty, 0.0) + g[MEAN_Y] * lens.fy
    vz = -r * (by[0] + by[1] + by[2]) - (tx * s.slope[0] + ty * s.slope[1]) * r  # U shrinks with z as the scales do
    v_position = wp.vec3(tx * r, ty * r, vz)
    # σ(−x) instead of 1 − σ(x), which cancels for nearly opaque splats.
    v_opacity[i] = g[OPACITY] * p[OPACITY] / (1.0 + wp.exp(opacity[i]))
    count = (lens.degree + 1) * (lens.degree + 1)
    color = wp.vec3(
        wp.where(p[RED] > 0.0, g[RED], 0.0), wp.where(p[GREEN] > 0.0, g[GREEN], 0.0),
        wp.where(p[BLUE] > 0.0, g[BLUE], 0.0),
    )  # fmt: skip
    if lens.depth_as_color:
        v_position += wp.vec3(0.0, 0.0, g[RED])
        color = wp.vec3(0.0, 0.0, 0.0)
    away = 1.0 / wp.length(s.position)
    d = lens.to_world * (s.position * away)
    b = _basis(lens.degree, d)
    weight = Basis()
    for k in range(wp.static(BASIS)):
        if k < sh.shape[1]:
            v_sh[i, k] = b[k] * color  # zero above the degree in use
            if k < count:
                weight[k] = wp.dot(color, sh[i, k])
    for k in range(v_strain_color.shape[1]):
        v_strain_color[i, k] = wp.where(k < lens.strains, strain[f, k] * color, wp.vec3(0.0, 0.0, 0.0))
    by_direction = _basis_gradient(lens.degree, d, weight)
    by_direction = (by_direction - wp.dot(by_direction, d) * d) * away
    v_position += wp.transpose(lens.to_world) * by_direction
    v_xyz[i] = wp.transpose(frame) * v_position
