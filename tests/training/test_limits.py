"""Limits that keep a splat near what it covers, against autograd; outlier resets."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.raster.cpu.optimizer import distance_limit, opacity_weight, scale_limit
from stga_addon.training.optimize.outliers import OutlierReset
from stga_addon.training.optimize.state import arrays_of
from stga_addon.training.optimize.step_hook import Schedule

from .toys import Rows, random_splats, random_state

FACES = 5
WEIGHT = 0.7


@pytest.fixture(params=range(3))
def scene(request):
    """Splats, half of them over their limits, some rows, and limits (F,) per triangle."""
    splats = random_splats(50, FACES, request.param)
    rng = np.random.default_rng(request.param)
    rows = np.flatnonzero(rng.random(50) < 0.7).astype(np.int32)
    limit = rng.uniform(0.5, 1.5, FACES).astype(np.float32)
    return splats, rows, limit


def expected(values, size, splats, rows, limits):
    """limits (2, F) of bound and of unbound splats."""
    x = torch.tensor(values, dtype=torch.float64, requires_grad=True)
    of = torch.tensor(
        limits[splats.unbound[rows].astype(int), splats.face[rows]], dtype=torch.float64
    )
    excess = torch.relu(size(x)[rows] - of.reshape(-1, *[1] * (size(x).dim() - 1)))
    norm = excess.norm()
    (WEIGHT * norm).backward()
    return norm.item(), x.grad.numpy()


def test_limits_and_weights_are_autograds(scene):
    """Catches a gradient without exponential or norm, along another axis, or of other rows, and 0/0
    of a norm that is zero."""
    splats, rows, limit = scene
    splats.xyz[0] = 0  # exactly at its triangle's origin
    rising = np.float32(0.6) * limit[::-1]
    for kernel, values, size, limits in (
        (scale_limit, splats.log_scale, torch.exp, np.exp(-5) * np.stack([limit, rising])),
        (distance_limit, splats.xyz, lambda x: x.norm(dim=1), [0.015 * limit, limit + np.inf]),
    ):
        limits = np.array(limits, np.float32)
        norm, gradient = expected(values, size, splats, rows, limits)
        assert norm > 0
        given = limits if kernel is scale_limit else limits[0]
        out = np.full((50, 3), 0.25, np.float32)
        found = kernel(rows, values, splats.face, splats.unbound, given, WEIGHT, out)
        assert found == pytest.approx(norm, rel=1e-5)
        assert_allclose(out - 0.25, gradient, rtol=1e-4, atol=1e-6)
        assert_array_equal(out[(gradient == 0).all(1)], 0.25)
        before = out.copy()
        wide = np.full_like(given, 10)
        assert kernel(rows, values, splats.face, splats.unbound, wide, WEIGHT, out) == 0
        assert_array_equal(out, before)
    share = np.random.default_rng(3).random(50, np.float32)
    x = torch.tensor(splats.opacity, dtype=torch.float64, requires_grad=True)
    (WEIGHT * torch.from_numpy(share)[rows] * torch.sigmoid(x[rows])).sum().backward()
    out = np.full(50, 0.25, np.float32)
    opacity_weight(rows, splats.opacity, share, WEIGHT, out)
    assert_allclose(out - 0.25, x.grad.numpy(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("to", [0.0, 0.5, 1.0])
def test_outlier_resets(to):
    """Catches a limit of another triangle, unbound splats pulled home, and momentum kept."""
    state = random_state(60, FACES)
    state.unbound[:] = np.arange(60) % 4 == 0
    limit = np.array([0.005, 0.012, 0.02, 0.03, 10.0], np.float32)
    xyz = state.parameters.xyz.astype(float)
    length = np.linalg.norm(xyz, axis=1, keepdims=True)
    wanted = {name: array.copy() for name, array in arrays_of(state).items()}
    far = length[:, 0] > limit[state.face]
    outliers = far & ~state.unbound
    assert 5 < outliers.sum() < 40
    assert far[state.unbound].any()
    pulled = (xyz / length * to * limit[state.face, None])[outliers]
    wanted["parameters/xyz"][outliers] = wanted["average/xyz"][outliers] = pulled
    wanted["first/xyz"][outliers] = 0
    reset = OutlierReset(1, limit, to)
    for _ in range(2):  # the second time, nothing is left to do
        reset.apply(Rows(state), Schedule(0, 0.5, 60))
        for name, array in arrays_of(state).items():
            assert_array_equal(array[~outliers], wanted[name][~outliers], err_msg=name)
            rounded = 1e-5 if name.endswith("xyz") else 0
            assert_allclose(array, wanted[name], rtol=rounded, err_msg=name)
