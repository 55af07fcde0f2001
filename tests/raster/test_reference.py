"""The reference renderer against closed forms and finite differences; gsplat's is elsewhere."""

import numpy as np
import pytest
import torch

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


def test_centered_frustum_limit_is_1_3_half_fields_of_view():
    """Catches a limit that is not symmetric on a centered camera, or ignores an off-center
    principal point."""
    slope = torch.tensor([-9.0, 9.0])
    centered = reference.clamp_to_frustum(slope, 100, 50.0, 50.0)
    np.testing.assert_allclose(centered, [-1.3, 1.3], rtol=1e-6)
    shifted = reference.clamp_to_frustum(slope, 100, 50.0, 60.0)
    np.testing.assert_allclose(shifted, [-1.5, 1.1], rtol=1e-6)
