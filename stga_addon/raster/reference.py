"""The renderer that the fast kernels are tested against: plain torch, any dtype, gradients by autograd.

Small scenes only: every splat is evaluated at every pixel.
"""

from math import pi, sqrt

import torch
from torch import Tensor

from ..capture.camera import Camera

MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
FRUSTUM_MARGIN = 0.3  # how far beyond the image, in half fields of view, the Jacobian still follows a splat


def render(
    xyz: Tensor,
    rotation: Tensor,
    log_scale: Tensor,
    opacity: Tensor,
    sh: Tensor,
    camera: Camera,
    sh_degree: int = 3,
    near: float = 0.01,
    low_pass: float = 0.3,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Image of world-space splats: color (3, H, W) on black, alpha (H, W), depth (H, W) = Σ weight · z.

    xyz (N, 3) meters, rotation (N, 4) wxyz of any length, log_scale (N, 3), opacity (N,) logit, sh (N, K, 3) of
    which the first (sh_degree + 1)² are used. near in meters, low_pass in square pixels, z the camera's.
    antialiased: opacity loses what low_pass adds to the projected area (Mip-Splatting, 2D filter).
    Splats closer than `near` are dropped; the rest are blended front to back by z, in input order where z ties.
    A pixel ends before the splat that would leave it a transmittance of MIN_TRANSMITTANCE or less
    (3D Gaussian Splatting, sections 4 to 6, with gsplat's constants).
    """
    view = torch.as_tensor(camera.world_to_camera, dtype=xyz.dtype, device=xyz.device)
    in_camera = xyz @ view[:3, :3].T + view[:3, 3]
    z = in_camera[:, 2].detach()
    order = torch.argsort(z, stable=True)
    order = order[z[order] >= near]

    covariance = view[:3, :3] @ _covariance(rotation[order], log_scale[order]) @ view[:3, :3].T
    position = torch.as_tensor(camera.position, dtype=xyz.dtype, device=xyz.device)
    color = sh_color(sh[order], xyz[order] - position, sh_degree)
    center, projected = _project(in_camera[order], covariance, camera, low_pass)
    visible = torch.sigmoid(opacity[order])
    if antialiased:
        blur = low_pass * torch.eye(2, dtype=xyz.dtype, device=xyz.device)
        visible = visible * (torch.linalg.det(projected - blur) / torch.linalg.det(projected)).clamp_min(0).sqrt()
    alpha = _alpha(center, projected, visible, camera)
    return _composite(alpha, color, in_camera[order, 2])


def sh_color(sh: Tensor, direction: Tensor, degree: int) -> Tensor:
    """Color (N, 3) ≥ 0 of coefficients sh (N, K, 3) seen along `direction` (N, 3), of any length."""
    count = (degree + 1) ** 2
    basis = sh_basis(torch.nn.functional.normalize(direction, dim=-1))[:, :count]
    return (0.5 + torch.einsum("nk,nkc->nc", basis, sh[:, :count])).clamp_min(0)


def sh_basis(direction: Tensor) -> Tensor:
    """Real spherical harmonics (N, 16) up to degree 3 of unit directions (N, 3), 3D Gaussian Splatting's signs."""
    x, y, z = direction.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
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


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Rotation matrices (N, 3, 3) of quaternions wxyz (N, 4) of any length."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _covariance(rotation: Tensor, log_scale: Tensor) -> Tensor:
    axes = rotation_matrix(rotation) * log_scale.exp()[:, None, :]
    return axes @ axes.mT


def _project(points: Tensor, covariance: Tensor, camera: Camera, low_pass: float) -> tuple[Tensor, Tensor]:
    """Center (N, 2) in pixels and 2D covariance (N, 2, 2) in square pixels of splats given in camera space."""
    x, y, z = points.unbind(-1)
    fx, fy = camera.fl_x, camera.fl_y
    slope_x = _clamp_to_frustum(x / z, camera.width, fx, camera.cx)
    slope_y = _clamp_to_frustum(y / z, camera.height, fy, camera.cy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([fx / z, zero, -fx * slope_x / z], dim=-1),
            torch.stack([zero, fy / z, -fy * slope_y / z], dim=-1),
        ],
        dim=-2,
    )
    blur = low_pass * torch.eye(2, dtype=points.dtype, device=points.device)
    center = torch.stack([fx * x / z + camera.cx, fy * y / z + camera.cy], dim=-1)
    return center, jacobian @ covariance @ jacobian.mT + blur


def _clamp_to_frustum(slope: Tensor, size: int, focal: float, principal: float) -> Tensor:
    """Far outside the image the linearized projection explodes, so its slope stays near the image's borders."""
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    return slope.clamp(-principal / focal - margin, (size - principal) / focal + margin)


def _alpha(center: Tensor, covariance: Tensor, opacity: Tensor, camera: Camera) -> Tensor:
    """Opacity (N, H, W) of every splat at every pixel center."""
    px = torch.arange(camera.width, dtype=center.dtype, device=center.device) + 0.5
    py = torch.arange(camera.height, dtype=center.dtype, device=center.device) + 0.5
    dx = px[None, None, :] - center[:, 0, None, None]
    dy = py[None, :, None] - center[:, 1, None, None]
    xx, xy, yy = (covariance[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    alpha = (opacity[:, None, None] * torch.exp(-distance / 2)).clamp_max(MAX_ALPHA)
    return torch.where(alpha >= MIN_ALPHA, alpha, 0)


def _composite(alpha: Tensor, color: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Blend splats given front to back: alpha (N, H, W), color (N, 3), z (N,)."""
    shape = alpha.shape[1:]
    transmittance = alpha.new_ones(shape)
    running = torch.ones(shape, dtype=torch.bool, device=alpha.device)
    rgb, depth = alpha.new_zeros(3, *shape), alpha.new_zeros(shape)
    for a, c, distance in zip(alpha, color, z, strict=True):
        remaining = transmittance * (1 - a)
        running = running & (remaining > MIN_TRANSMITTANCE)
        weight = torch.where(running, transmittance * a, 0)
        rgb = rgb + c[:, None, None] * weight
        depth = depth + distance * weight
        transmittance = torch.where(running, remaining, transmittance)
    return rgb, 1 - transmittance, depth
