"""Limits that keep a splat near what it covers, against autograd; stray resets."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal, assert_equal

from stga_addon.raster.cpu.optimizer import distance_limit, opacity_weight, scale_limit
from stga_addon.training.optimize.change import Turn
from stga_addon.training.optimize.strays import StrayReset

from .toys import Rows, bits, random_splats, random_state

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
    """Catches a gradient without exponential or norm, along another axis, or of other rows."""
    splats, rows, limit = scene
    limits = np.stack([limit, 0.6 * limit[::-1]]).astype(np.float32) * np.float32(np.exp(-5))
    norm, gradient = expected(splats.log_scale, torch.exp, splats, rows, limits)
    assert norm > 0
    out = np.full((50, 3), 0.25, np.float32)
    found = scale_limit(rows, splats.log_scale, splats.face, splats.unbound, limits, WEIGHT, out)
    assert found == pytest.approx(norm, rel=1e-5)
    assert_allclose(out - 0.25, gradient, rtol=1e-4, atol=1e-7)
    assert (gradient[rows[splats.unbound[rows]]] > 0).any()
    untouched = ~np.isin(np.arange(50), rows)
    assert_array_equal(out[untouched], 0.25)
    limit = limit * np.float32(0.015)
    limits = np.stack([limit, np.full_like(limit, np.inf)])
    norm, gradient = expected(splats.xyz, lambda x: x.norm(dim=1), splats, rows, limits)
    assert norm > 0
    out = np.full((50, 3), 0.25, np.float32)
    found = distance_limit(rows, splats.xyz, splats.face, splats.unbound, limit, WEIGHT, out)
    assert found == pytest.approx(norm, rel=1e-5)
    assert_allclose(out - 0.25, gradient, rtol=1e-4, atol=1e-6)
    untouched = splats.unbound | ~np.isin(np.arange(50), rows)
    assert_array_equal(out[untouched], 0.25)
    share = np.random.default_rng(3).random(50, np.float32)
    x = torch.tensor(splats.opacity, dtype=torch.float64, requires_grad=True)
    (WEIGHT * torch.from_numpy(share)[rows] * torch.sigmoid(x[rows])).sum().backward()
    out = np.full(50, 0.25, np.float32)
    opacity_weight(rows, splats.opacity, share, WEIGHT, out)
    assert_allclose(out - 0.25, x.grad.numpy(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kernel", [scale_limit, distance_limit])
def test_within_the_limits_nothing_happens(kernel):
    """Catches 0/0 of a norm that is zero, also for a splat exactly at its triangle's origin."""
    splats = random_splats(8, FACES)
    splats.xyz[0] = 0
    out = np.full((8, 3), 0.25, np.float32)
    values = splats.log_scale if kernel is scale_limit else splats.xyz
    rows = np.arange(8, dtype=np.int32)
    limit = np.full(FACES, 10, np.float32)
    limit = np.stack([limit, limit]) if kernel is scale_limit else limit
    assert kernel(rows, values, splats.face, splats.unbound, limit, WEIGHT, out) == 0
    assert_array_equal(out, 0.25)


@pytest.mark.parametrize("to", [0.0, 0.5, 1.0])
def test_stray_resets(to):
    """Catches a limit of another triangle, unbound splats pulled home, and momentum kept."""
    state = random_state(60, FACES)
    state.unbound[:] = np.arange(60) % 4 == 0
    limit = np.array([0.005, 0.012, 0.02, 0.03, 10.0], np.float32)
    xyz = state.parameters.xyz.copy()
    face = state.face
    far = [
        bool(np.hypot(np.hypot(*p[:2]), p[2]) > limit[f])
        for p, f in zip(xyz.astype(float), face, strict=True)
    ]
    strays = np.array(far) & (np.arange(60) % 4 != 0)
    assert 5 < strays.sum() < 40
    assert np.array(far)[::4].any()
    before = bits(state)
    reset = StrayReset(1, limit, to)
    reset.apply(Rows(state), Turn(0, 0.5, 60))
    after = bits(state)
    for name, old in before.items():
        if name in ("parameters/xyz", "first/xyz"):
            assert_array_equal(after[name][~strays], old[~strays])
        if name == "average/xyz":
            assert_array_equal(after[name][~strays], old[~strays])
            assert_array_equal(after[name][strays], after["parameters/xyz"][strays])
        elif name == "parameters/xyz":
            length = np.linalg.norm(xyz[strays].astype(float), axis=1, keepdims=True)
            wanted = xyz[strays] / length * to * limit[face[strays], None]
            assert_allclose(state.parameters.xyz[strays], wanted, rtol=1e-5)
        elif name == "first/xyz":
            assert not after[name][strays].any()
        else:
            assert_array_equal(after[name], old, err_msg=name)
    reset.apply(Rows(state), Turn(0, 0.5, 60))
    assert_equal(after, bits(state))
