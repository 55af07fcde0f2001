"""The reference renderer against closed forms, scipy's harmonics and finite differences."""

import numpy as np
import pytest
import torch
from scipy.special import factorial, lpmv

from raster import reference
from stga_addon.capture.camera import Camera


def camera_on_axis(width: int, height: int, focal: float) -> Camera:
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def one_splat(
    z: float, logit: float, log_sigma: float, raw_color: float = 0.0
) -> list[torch.Tensor]:
    columns = [[[0, 0, z]], [[1, 0, 0, 0]], [[log_sigma] * 3], [logit], [[[raw_color] * 3]]]
    return [torch.tensor(column, dtype=torch.float64) for column in columns]


def stacked(*splats: list[torch.Tensor]) -> list[torch.Tensor]:
    return [torch.cat(columns) for columns in zip(*splats, strict=True)]


def test_isotropic_splat_has_the_closed_form():
    """Catches a wrong focal length, pixel center, low-pass or depth: on the axis the projection is
    exact."""
    z, sigma, logit, focal = 4.0, 0.3, 0.7, 20.0
    rgb, alpha, depth = reference.render(
        *one_splat(z, logit, np.log(sigma)), camera_on_axis(9, 7, focal), sh_degree=0
    )
    columns, rows = np.meshgrid(np.arange(9) + 0.5 - 4.5, np.arange(7) + 0.5 - 3.5)
    variance = (focal * sigma / z) ** 2 + 0.3
    expected = 1 / (1 + np.exp(-logit)) * np.exp(-(columns**2 + rows**2) / (2 * variance))
    expected[expected < 1 / 255] = 0
    np.testing.assert_allclose(alpha, expected, atol=1e-12)
    np.testing.assert_allclose(depth, z * expected, atol=1e-12)
    np.testing.assert_allclose(rgb, np.stack([0.5 * expected] * 3), atol=1e-12)


def test_harmonics_are_scipys():
    """Catches a wrong constant or sign in any of the 16 basis functions."""
    direction = np.random.default_rng(0).normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    azimuth, cosine = np.arctan2(direction[:, 1], direction[:, 0]), direction[:, 2]
    columns = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            order = abs(m)
            size = (
                (2 * degree + 1)
                / (4 * np.pi)
                * factorial(degree - order)
                / factorial(degree + order)
            )
            wave = np.sin(order * azimuth) if m < 0 else np.cos(order * azimuth)
            columns.append(np.sqrt(size * (2 if m else 1)) * lpmv(order, degree, cosine) * wave)
    np.testing.assert_allclose(
        reference.sh_basis(torch.from_numpy(direction)), np.stack(columns, axis=-1), atol=1e-12
    )


def test_rotation_matrix_is_scipys():
    """Catches a quaternion read as xyzw, or not normalized."""
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    quaternion = np.random.default_rng(1).normal(size=(20, 4)) * 3
    expected = rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(
        reference.rotation_matrix(torch.from_numpy(quaternion)), expected, atol=1e-12
    )


def test_pixel_ends_before_the_splat_that_would_close_it():
    """Catches blending the closing splat: alphas 0.999, 0.8, 0.9 leave 1e-3, 2e-4, and the third is
    left out."""
    wide = 5.0  # constant over the single pixel
    splats = stacked(
        one_splat(4.0, np.log(0.9 / 0.1), wide),
        one_splat(2.0, 20.0, wide),
        one_splat(3.0, np.log(0.8 / 0.2), wide),
    )
    _, alpha, depth = reference.render(*splats, camera_on_axis(1, 1, 1.0), sh_degree=0)
    assert alpha.item() == pytest.approx(1 - 2e-4, abs=1e-6)
    assert depth.item() == pytest.approx(0.999 * 2 + 0.001 * 0.8 * 3, abs=1e-6)


def test_splats_nearer_than_near_are_dropped():
    """Catches splats behind the camera that mirror into the image."""
    splats = stacked(one_splat(-1.0, 3.0, -1.0), one_splat(0.005, 3.0, -1.0))
    rgb, alpha, depth = reference.render(*splats, camera_on_axis(5, 4, 5.0), sh_degree=0)
    for image in (rgb, alpha, depth):
        assert not image.any()


def test_color_is_never_negative():
    """Catches a missing clamp of the harmonics' color at zero."""
    splats = one_splat(2.0, 2.0, -1.0, raw_color=-4.0)
    rgb, alpha, _ = reference.render(*splats, camera_on_axis(5, 4, 5.0), sh_degree=0)
    assert alpha.max() > 0.5
    assert not rgb.any()


def test_centered_frustum_limit_is_1_3_half_fields_of_view():
    """Catches a limit that is not symmetric on a centered camera, or ignores an off-center
    principal point."""
    slope = torch.tensor([-9.0, 9.0])
    centered = reference.clamp_to_frustum(slope, 100, 50.0, 50.0)
    np.testing.assert_allclose(centered, [-1.3, 1.3], rtol=1e-6)
    shifted = reference.clamp_to_frustum(slope, 100, 50.0, 60.0)
    np.testing.assert_allclose(shifted, [-1.5, 1.1], rtol=1e-6)


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_gradients_are_the_finite_differences(sh_degree):
    """Catches a detached path (depth, direction of the harmonics, clamped Jacobian) in the
    reference itself."""
    generator = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    count = 4
    xyz = normal(count, 3) * 0.5 + torch.tensor([0.0, 0.0, 3.0])
    xyz[0, 0] = 6.0  # outside the image, beyond the Jacobian's limit, wide enough to be seen
    log_scale = normal(count, 3) * 0.3 - 1
    log_scale[0] = 1.2
    splats = [
        xyz,
        normal(count, 4),
        log_scale,
        normal(count),
        normal(count, (sh_degree + 1) ** 2, 3) * 0.3,
    ]
    camera = Camera(5, 4, 5.0, 4.5, 2.6, 1.9, np.eye(4))
    for tensor in splats:
        tensor.requires_grad_()

    def image(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return reference.render(*tensors, camera, sh_degree=sh_degree)

    assert torch.autograd.gradcheck(image, splats, eps=1e-6, atol=1e-6)
