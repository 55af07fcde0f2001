"""Cross-validated evidence against colors whose dependence is known."""

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.training.effects.evidence import consecutive_folds, linear_evidence, scattered_folds

VIEWS = 48
TRIANGLES = 60
GROUP = np.arange(VIEWS) // 6
"""Eight timesteps of six cameras each."""
FOLDS = consecutive_folds(GROUP)


def test_a_linear_dependence_is_found_and_noise_is_not():
    """Catches a gain from samples that the model was fitted to."""
    rng = default_rng(0)
    features = rng.normal(0, 1, (8, TRIANGLES, 3))[GROUP]
    noise = rng.normal(100, 2, (VIEWS, TRIANGLES, 3))
    slope = rng.normal(0, 5, (TRIANGLES, 3, 3))
    follows = linear_evidence(noise + np.einsum("skd,kdc->skc", features, slope), features, FOLDS)
    assert 7.5 < follows.gain < 10  # 5 · √3 is 8.7
    assert linear_evidence(noise, features, FOLDS).gain < 0.5


def test_features_beyond_the_fitted_range_are_clipped():
    """Catches one extrapolated expression that outweighs what all others gain."""
    rng = default_rng(1)
    strength = np.array([0.2, -0.3, 0.5, -0.5, 0.4, -0.2, 0.3, 4.0])
    features = np.zeros((VIEWS, TRIANGLES, 3))
    features[..., 0] = strength[GROUP][:, None]
    noise = rng.normal(0, 1, (VIEWS, TRIANGLES, 3))
    color = 100 + 20 * np.clip(features[..., :1], -0.6, 0.6) + noise
    assert linear_evidence(color, features, FOLDS).gain == 0
    rest = np.zeros((TRIANGLES, 3))
    assert linear_evidence(color, features, FOLDS, rest=rest).gain > 5
    inside = features[GROUP != 7], consecutive_folds(GROUP[GROUP != 7])
    free, limited = (
        linear_evidence(color[GROUP != 7], *inside, rest=given) for given in (None, rest)
    )
    assert abs(free.gain - limited.gain) < 0.5


def test_the_range_is_counted_from_rest():
    """Catches a margin counted from 0: a constant added to all strain changes nothing."""
    rng = default_rng(2)
    rest = np.zeros((TRIANGLES, 3))
    features = rng.normal(0, 1, (8, TRIANGLES, 3))[GROUP]
    color = 100 + 20 * np.clip(features, -0.6, 0.6) + rng.normal(0, 1, (VIEWS, TRIANGLES, 3))
    plain, shifted = (
        linear_evidence(color, features + by, FOLDS, rest=rest + by) for by in (0.0, -0.2)
    )
    assert plain.gain > 5
    assert_allclose(shifted.gain, plain.gain, rtol=1e-9)


def slowly(rng, timesteps, *shape):
    """(timesteps, *shape) noise of deviation 1, like itself for some three timesteps."""
    weights = np.hanning(8)[1:-1]
    noise = rng.normal(size=(timesteps + len(weights) - 1, *shape))
    windows = np.lib.stride_tricks.sliding_window_view(noise, len(weights), 0)
    return windows @ weights / np.linalg.norm(weights)


@pytest.mark.parametrize("timesteps", [8, 12])
def test_what_only_neighboring_timesteps_know(timesteps):
    """Catches slow colors and features of no relation, predicted from neighbors."""
    timestep = np.repeat(np.arange(timesteps), 6)
    for seed in range(4):
        rng = default_rng(seed)
        features = slowly(rng, timesteps, TRIANGLES, 3)[timestep]
        noise = rng.normal(100, 1, (len(timestep), TRIANGLES, 3))
        color = noise + 6 * slowly(rng, timesteps, TRIANGLES, 3)[timestep]
        assert linear_evidence(color, features, consecutive_folds(timestep)).gain < 0.5
        assert linear_evidence(color, features, scattered_folds(timestep)).gain > 2


@pytest.mark.parametrize(("timesteps", "folds"), [(1, 0), (2, 0), (3, 2), (5, 4), (12, 4)])
def test_each_timestep_is_held_out_once(timesteps, folds):
    """Catches a model fitted to timesteps beside the fold, and folds without any to fit."""
    timestep = np.repeat(7 * np.arange(timesteps), 2)
    found = consecutive_folds(timestep)
    assert len(found) == folds
    assert all(fitted.any() and not (held & fitted).any() for held, fitted in found)
    if timesteps > 3:
        assert_array_equal(sum(held.astype(int) for held, _ in found), 1)
    for held, fitted in found:
        distance = np.abs(timestep[held][:, None] - timestep[fitted])
        assert distance.min() == 14
