"""Reference renderer: one plain torch function per stage, against which both sets of kernels are
tested.

Any dtype, gradients by autograd. Small scenes only: every splat is evaluated at every pixel.
Stages: `embed` (triangles to world space), `layers` (by `project` and `splat_alpha`), `sh_color`
and `blend`, which `render` chains, and `image_loss`.
"""

from math import pi, sqrt

import torch
from torch.nn.functional import conv2d, normalize

MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
LOW_PASS_PX2 = 0.3
NEAR_M = 0.01
FRUSTUM_MARGIN = 0.3
"""How far beyond the image, in half fields of view, the Jacobian still follows a splat."""


def render(
    xyz, rotation, log_scale, opacity, sh, camera, sh_degree=3, near=NEAR_M, antialiased=False
):
    """Image of world-space splats: color (3, H, W) on black, alpha (H, W), depth (H, W) = Σ weight
    · z.

    xyz (N, 3) meters, rotation (N, 4) wxyz of any length, log_scale (N, 3), opacity (N,) logit, sh
    (N, K, 3) of which the first (sh_degree + 1)² are used. near in meters, z the camera's.
    antialiased: opacity loses what the low-pass adds to the projected area (Mip-Splatting, 2D
    filter). Splats closer than `near` are dropped; the rest are blended front to back by z, in
    input order where z ties. (3D Gaussian Splatting, sections 4 to 6, with gsplat's constants.)
    """
    placed = xyz, rotation, log_scale, torch.sigmoid(opacity)
    order, alpha, depth = layers(*placed, camera, near, antialiased)
    position = torch.as_tensor(camera.position, dtype=xyz.dtype, device=xyz.device)
    return blend(alpha, sh_color(sh[order], xyz[order] - position, sh_degree), depth)


def layers(
    xyz, rotation, log_scale, opacity, camera, near=NEAR_M, antialiased=False, moved_px=None
):
    """The splats of `render` front to back: their numbers, alpha (N, H, W) and depth (N,).

    opacity (N,) 0 to 1; moved_px (N, 2): added to the projected centers.
    """
    z = camera_space(xyz, camera)[:, 2].detach()
    order = torch.argsort(z, stable=True)
    order = order[z[order] >= near]
    center, covariance, depth, compensation = project(
        xyz[order], rotation[order], log_scale[order], camera
    )
    if moved_px is not None:
        center = center + moved_px[order]
    visible = opacity[order] * compensation if antialiased else opacity[order]
    return order, splat_alpha(center, covariance, visible, camera), depth


def embed(xyz, rotation, log_scale, frames, face):
    """World-space xyz (N, 3), rotation (N, 4) wxyz and log_scale (N, 3) of splats in the frames of
    triangles face (N,)."""
    n = len(xyz)
    assert xyz.shape == log_scale.shape == (n, 3), (xyz.shape, log_scale.shape)
    assert rotation.shape == (n, 4), rotation.shape
    assert face.shape == (n,), face.shape
    origin, axes, quaternion, scale = (
        torch.as_tensor(array, dtype=xyz.dtype)[face]
        for array in (frames.origin, frames.rotation, frames.quaternion, frames.scale)
    )
    w, x, y, z = quaternion.unbind(-1)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    product = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)  # quaternion ⊗ ·
    world = scale[:, None] * torch.einsum("nij,nj->ni", axes, xyz) + origin
    return world, torch.einsum("nij,nj->ni", product, rotation), log_scale + scale.log()[:, None]


def camera_space(xyz, camera):
    """World points (N, 3) in camera space (N, 3)."""
    assert xyz.shape == (len(xyz), 3), xyz.shape
    view = torch.as_tensor(camera.world_to_camera, dtype=xyz.dtype, device=xyz.device)
    return xyz @ view[:3, :3].T + view[:3, 3]


def project(xyz, rotation, log_scale, camera):
    """Project N world-space Gaussians; all must be in front of the camera.

    Returns center (N, 2) in pixels, covariance (N, 2, 2) in square pixels with the low-pass, depth
    (N,) in meters, and
    compensation (N,): the factor of opacity that keeps what the low-pass adds from showing.
    """
    n = len(xyz)
    assert xyz.shape == log_scale.shape == (n, 3), (xyz.shape, log_scale.shape)
    assert rotation.shape == (n, 4), rotation.shape
    turn = torch.as_tensor(camera.world_to_camera[:3, :3], dtype=xyz.dtype, device=xyz.device)
    axes = turn @ (rotation_matrix(rotation) * log_scale.exp()[:, None, :])
    x, y, z = camera_space(xyz, camera).unbind(-1)
    fx = camera.fl_x
    fy = camera.fl_y
    slope_x = clamp_to_frustum(x / z, camera.width, fx, camera.cx)
    slope_y = clamp_to_frustum(y / z, camera.height, fy, camera.cy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([fx / z, zero, -fx * slope_x / z], dim=-1),
            torch.stack([zero, fy / z, -fy * slope_y / z], dim=-1),
        ],
        dim=-2,
    )
    center = torch.stack([fx * x / z + camera.cx, fy * y / z + camera.cy], dim=-1)
    sharp = jacobian @ (axes @ axes.mT) @ jacobian.mT
    covariance = sharp + LOW_PASS_PX2 * torch.eye(2, dtype=xyz.dtype, device=xyz.device)
    compensation = (torch.linalg.det(sharp) / torch.linalg.det(covariance)).clamp_min(0).sqrt()
    return center, covariance, z, compensation


def clamp_to_frustum(slope, size, focal, principal):
    """Slopes x/z or y/z (N,) kept near the image's borders: the linearized projection explodes far
    outside it."""
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    return slope.clamp(-principal / focal - margin, (size - principal) / focal + margin)


def rotation_matrix(quaternion):
    """Rotation matrices (N, 3, 3) of quaternions wxyz (N, 4) of any length."""
    assert quaternion.shape == (len(quaternion), 4), quaternion.shape
    w, x, y, z = normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def sh_color(sh, direction, degree):
    """Color (N, 3) ≥ 0 of coefficients sh (N, K, 3) seen along `direction` (N, 3), of any
    length."""
    count = (degree + 1) ** 2
    assert direction.shape == (len(sh), 3), direction.shape
    assert sh.shape == (len(sh), sh.shape[1], 3), sh.shape
    assert sh.shape[1] >= count, sh.shape
    basis = sh_basis(normalize(direction, dim=-1))[:, :count]
    return (0.5 + torch.einsum("nk,nkc->nc", basis, sh[:, :count])).clamp_min(0)


def sh_basis(direction):
    """Real spherical harmonics (N, 16) up to degree 3 of unit directions (N, 3), 3D Gaussian
    Splatting's signs."""
    assert direction.shape == (len(direction), 3), direction.shape
    x, y, z = direction.unbind(-1)
    xx = x * x
    yy = y * y
    zz = z * z
    return torch.stack(
        [
            torch.full_like(x, sqrt(1 / (4 * pi))),
            -sqrt(3 / (4 * pi)) * y,
            sqrt(3 / (4 * pi)) * z,
            -sqrt(3 / (4 * pi)) * x,
            sqrt(15 / (4 * pi)) * x * y,
            -sqrt(15 / (4 * pi)) * y * z,
            sqrt(5 / (16 * pi)) * (2 * zz - xx - yy),
            -sqrt(15 / (4 * pi)) * x * z,
            sqrt(15 / (16 * pi)) * (xx - yy),
            -sqrt(35 / (32 * pi)) * y * (3 * xx - yy),
            sqrt(105 / (4 * pi)) * x * y * z,
            -sqrt(21 / (32 * pi)) * y * (4 * zz - xx - yy),
            sqrt(7 / (16 * pi)) * z * (2 * zz - 3 * xx - 3 * yy),
            -sqrt(21 / (32 * pi)) * x * (4 * zz - xx - yy),
            sqrt(105 / (16 * pi)) * z * (xx - yy),
            -sqrt(35 / (32 * pi)) * x * (xx - 3 * yy),
        ],
        dim=-1,
    )


def splat_alpha(center, covariance, opacity, camera):
    """Alpha (N, H, W) of projected splats at every pixel's center: center (N, 2), covariance (N, 2,
    2), opacity (N,)."""
    n = len(center)
    assert center.shape == (n, 2), center.shape
    assert covariance.shape == (n, 2, 2), covariance.shape
    assert opacity.shape == (n,), opacity.shape
    px = torch.arange(camera.width, dtype=center.dtype, device=center.device) + 0.5
    py = torch.arange(camera.height, dtype=center.dtype, device=center.device) + 0.5
    dx = px[None, None, :] - center[:, 0, None, None]
    dy = py[None, :, None] - center[:, 1, None, None]
    xx, xy, yy = (covariance[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    alpha = (opacity[:, None, None] * torch.exp(-distance / 2)).clamp_max(MAX_ALPHA)
    return torch.where(alpha >= MIN_ALPHA, alpha, 0)


def blend(alpha, color, depth):
    """Blend splats given front to back: alpha (N, H, W), color (N, 3), depth (N,), to the three
    images of `render`.

    A pixel ends before the splat that would leave it a transmittance of MIN_TRANSMITTANCE or less.
    """
    n, *shape = alpha.shape
    assert color.shape == (n, 3), color.shape
    assert depth.shape == (n,), depth.shape
    transmittance = alpha.new_ones(shape)
    running = torch.ones(shape, dtype=torch.bool, device=alpha.device)
    rgb = alpha.new_zeros(3, *shape)
    distance = alpha.new_zeros(shape)
    for a, c, z in zip(alpha, color, depth, strict=True):
        remaining = transmittance * (1 - a)
        running = running & (remaining > MIN_TRANSMITTANCE)
        weight = torch.where(running, transmittance * a, 0)
        rgb = rgb + c[:, None, None] * weight
        distance = distance + z * weight
        transmittance = torch.where(running, remaining, transmittance)
    return rgb, 1 - transmittance, distance


def image_loss(image, target):
    """Maps (3, H, W) of |difference| and SSIM of two images (3, H, W) in 0…1; the loss mixes 1 −
    SSIM and the other.

    SSIM: Gaussian window of 11 pixels, σ 1.5, zero padding (Wang et al. 2004, as used by 3D
    Gaussian Splatting).
    """
    assert image.shape == target.shape == (3, *image.shape[1:]), (image.shape, target.shape)
    line = torch.exp(-(torch.arange(-5.0, 6.0, dtype=image.dtype) ** 2) / (2 * 1.5**2))
    window = torch.outer(line, line) / line.sum() ** 2

    def blur(values):
        return conv2d(values[:, None], window[None, None], padding=5)[:, 0]

    x = blur(image)
    y = blur(target)
    c1 = 0.01**2
    c2 = 0.03**2
    variances = blur(image * image) - x**2 + blur(target * target) - y**2
    covariance = blur(image * target) - x * y
    ssim = (2 * x * y + c1) * (2 * covariance + c2) / ((x**2 + y**2 + c1) * (variances + c2))
    return (image - target).abs(), ssim
