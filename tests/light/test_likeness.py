"""What a scene's light keeps of recorded colors, on a ball under a plate."""

from dataclasses import replace

import numpy as np
import pytest

from light.scenes import lit_avatar
from stga_addon.light.harmonics import basis, rotated, uniform
from stga_addon.light.relight import Relighter, kept, kept_shares
from stga_addon.light.values import Light, Lighting

EYE = np.array([0.2, 0.1, 1.0])
TINT = np.array([1.4, 1.0, 0.6])


def studio() -> np.ndarray:
    """(9, 3) harmonics that are brighter from the front and above."""
    light = uniform((0.5, 0.45, 0.4))
    light[1:3] = [[0.3] * 3, [0.5, 0.4, 0.4]]
    return light


def relighter_of(light: np.ndarray) -> Relighter:
    """Of the ball as it would have been recorded in a light (9, 3)."""
    avatar = lit_avatar(degree=1)
    assert avatar.light is not None
    relighter = Relighter(avatar)
    arriving = avatar.light.transfer @ light
    arriving = (arriving + relighter.bounce.light(arriving)).astype(np.float32)
    avatar.splats.sh[:, 1:] = 0.05
    return Relighter(replace(avatar, light=replace(avatar.light, irradiance=arriving)))


def test_the_captures_light_is_found_in_the_heads_axes():
    """Catches light between skin and skin that is taken for the studio's, and channels that are
    exchanged."""
    np.testing.assert_allclose(relighter_of(studio()).recorded_light, studio(), atol=0.01)


def test_the_captures_own_light_keeps_all_that_was_recorded():
    """Catches highlights of the studio that are lost under it, a tint or level that is not that of
    the light, and a head that turns away from its studio or takes the studio along."""
    relighter = relighter_of(studio())
    mesh = relighter.avatar.neutral.astype(np.float64)
    recorded = relighter.radiance(mesh, EYE, Lighting(mode="recorded"))
    np.testing.assert_allclose(
        relighter.radiance(mesh, EYE, Lighting(studio() * TINT)), recorded * TINT, rtol=0.03
    )
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    along, turned = Lighting(rotated(studio(), turn)), mesh @ turn.T
    there = relighter.radiance(turned, EYE, replace(along, mode="recorded"))
    np.testing.assert_allclose(relighter.radiance(turned, EYE, along), there, rtol=0.03)
    assert relighter.distant_in_head(mesh, Lighting(studio()))[1].share > 0.99
    assert relighter.distant_in_head(turned, Lighting(studio()))[1].share < 0.1


def test_another_light_keeps_nothing():
    """Catches recorded shades that shine through under a light from elsewhere, and a share that
    jumps while the light moves away."""
    relighter = relighter_of(studio())
    mesh = relighter.avatar.neutral.astype(np.float64)
    shares = []
    for strength in np.linspace(0, 3, 61):
        lamp = Light("sun", np.full(3, strength), direction=(1, 0.2, 0))
        shares.append(relighter.distant_in_head(mesh, Lighting(studio(), (lamp,)))[1].share)
    steps = -np.diff(shares)
    assert shares[0] > 0.99
    assert shares[-1] == 0
    assert (steps >= 0).all()
    assert steps.max() < 0.1


@pytest.mark.parametrize("options", [{"specular": 0.0}, {"roughness": 0.9}])
def test_other_highlights_keep_nothing(options):
    """Catches highlights of the capture that stay although others, or none, are asked for."""
    relighter = relighter_of(studio())
    assert (
        relighter.distant_in_head(relighter.avatar.neutral, Lighting(studio(), **options))[1].share
        == 0
    )


def test_shadows_of_other_objects_stay():
    """Catches a shadow that vanishes because the light as a whole is the capture's."""
    same = kept(studio(), 2 * studio())
    irradiance = np.maximum(basis(np.eye(3)) @ studio(), 0.1).astype(np.float32)
    arriving = irradiance * np.float32([[2], [1.9], [0.3]])
    np.testing.assert_allclose(kept_shares(same, arriving, irradiance), [1, 1, 0], atol=1e-6)
