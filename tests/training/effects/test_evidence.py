"""Cross-validated evidence against colors whose dependence is known."""

import numpy as np

from stga_addon.training.effects.evidence import linear_evidence

VIEWS, TRIANGLES = 48, 60
GROUP = np.arange(VIEWS) // 6
"""Eight timesteps of six cameras each."""


def test_a_linear_dependence_is_found_and_noise_is_not() -> None:
    """Catches a gain from samples that the model was fitted to."""
    rng = np.random.default_rng(0)
    features = rng.normal(0, 1, (8, TRIANGLES, 3))[GROUP]
    noise = rng.normal(100, 2, (VIEWS, TRIANGLES, 3))
    slope = rng.normal(0, 5, (TRIANGLES, 3, 3))
    follows = linear_evidence(noise + np.einsum("skd,kdc->skc", features, slope), features, GROUP)
    assert 7.5 < follows.gain < 10  # 5 · √3 is 8.7
    assert linear_evidence(noise, features, GROUP).gain < 0.5


def test_features_beyond_the_fitted_range_are_clipped() -> None:
    """Catches evidence against colors that saturate, which an avatar with its range of strain can hold: the one
    extrapolated expression would outweigh what all the others gain."""
    rng = np.random.default_rng(1)
    strength = np.array([0.2, -0.3, 0.5, -0.5, 0.4, -0.2, 0.3, 4.0])
    features = np.zeros((VIEWS, TRIANGLES, 3))
    features[..., 0] = strength[GROUP][:, None]
    color = 100 + 20 * np.clip(features[..., :1], -0.6, 0.6) + rng.normal(0, 1, (VIEWS, TRIANGLES, 3))
    assert linear_evidence(color, features, GROUP).gain == 0
    rest = np.zeros((TRIANGLES, 3))
    assert linear_evidence(color, features, GROUP, rest=rest).gain > 5
    inside = features[GROUP != 7], GROUP[GROUP != 7]
    free, limited = (linear_evidence(color[GROUP != 7], *inside, rest=given) for given in (None, rest))
    assert abs(free.gain - limited.gain) < 0.5


def test_the_range_is_counted_from_rest() -> None:
    """Catches a margin counted from 0: a constant added to all strain, at rest too, changes nothing that colors say."""
    rng = np.random.default_rng(2)
    rest, features = np.zeros((TRIANGLES, 3)), rng.normal(0, 1, (8, TRIANGLES, 3))[GROUP]
    color = 100 + 20 * np.clip(features, -0.6, 0.6) + rng.normal(0, 1, (VIEWS, TRIANGLES, 3))
    plain, shifted = (linear_evidence(color, features + by, GROUP, rest=rest + by) for by in (0.0, -0.2))
    assert plain.gain > 5
    np.testing.assert_allclose(shifted.gain, plain.gain, rtol=1e-9)
