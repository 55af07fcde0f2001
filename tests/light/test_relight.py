"""Relit colors of an avatar whose truth is known: a ball of one albedo under a plate."""

from dataclasses import replace

import numpy as np
import pytest

from light.scenes import lit_avatar
from stga_addon.avatar.splats import sh_color
from stga_addon.capture.color import srgb_to_linear
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.errors import StgaError
from stga_addon.light import relight
from stga_addon.light.harmonics import even_directions, rotated, uniform
from stga_addon.light.relight import Relighter
from stga_addon.light.values import Light, Lighting

EYE = np.array([0.0, 0.0, 1.0])
ALBEDO = (0.5, 0.3, 0.2)


@pytest.fixture(scope="module")
def relighter() -> Relighter:
    return Relighter(lit_avatar(ALBEDO))


def turned(mesh: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The mesh turned about y and moved; and the rotation."""
    a = np.radians(degrees)
    rotation = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return mesh @ rotation.T + [0.3, 0.1, -0.2], rotation


def test_albedo_is_what_was_recorded_without_its_light(relighter):
    """Catches a wrong factor of π, and highlights that stay in the albedo."""
    lit = relighter.light.occlusion[relighter.corners].min(1) > 0.3
    np.testing.assert_allclose(relighter.albedo[lit], np.tile(ALBEDO, (lit.sum(), 1)), rtol=0.02)


def normals_of(relighter):
    """(N, 3) the neutral mesh's smooth normals at the splats."""
    normals = relighter._at_splats(
        vertex_normals(relighter.avatar.neutral.astype(np.float64), relighter.avatar.faces)
    )
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_a_sun_gives_lamberts_cosine(relighter):
    """Catches irradiance in other units than Blender's: albedo times strength times cosine over
    π."""
    sun = Light("sun", np.array([2.0, 2.0, 2.0]), direction=(0, 1, 0))
    lit = relighter.radiance(relighter.avatar.neutral, EYE, Lighting(lights=(sun,), specular=0))
    normals = normals_of(relighter)
    down = (normals[:, 1] < -0.3) & (
        np.linalg.norm(relighter.avatar.neutral[relighter.corners[:, 0]], axis=1) < 0.101
    )
    assert down.sum() > 100
    expected = np.array(ALBEDO) * 2 * -normals[down, 1:2] / np.pi
    np.testing.assert_allclose(lit[down], expected, rtol=0.03, atol=0.004)


def test_light_that_turns_with_the_head_changes_nothing(relighter):
    """Catches world light, highlights or shadows in the axes of another space than the head's."""
    mesh = relighter.avatar.neutral.astype(np.float64)
    moved, rotation = turned(mesh, 50)
    world = uniform((0.1, 0.2, 0.3))
    world[1:4] = [[0.05] * 3, [0.1] * 3, [-0.1] * 3]
    lamp = Light("point", np.array([20.0, 15.0, 10.0]), (0.4, 0.6, 0.3))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, [0.3, 0.1, -0.2]
    here = relighter.radiance(mesh, EYE, Lighting(world, (lamp,)))
    there_light = Lighting(rotated(world, rotation), (lamp.transformed(matrix),))
    there = relighter.radiance(moved, matrix[:3, :3] @ EYE + matrix[:3, 3], there_light)
    # the shadow map's texels lie elsewhere
    assert np.abs(here - there).mean() < 0.002 * here.mean() + 2e-3


def test_a_still_head_under_still_light_does_not_flicker(relighter):
    """Catches anything random, or a state that one frame leaves to the next."""
    mesh, lamp = (
        relighter.avatar.neutral,
        Light("spot", np.ones(3) * 40, (0.2, 0.3, 0.8), direction=(-0.2, -0.3, -0.8)),
    )
    lighting = Lighting(uniform((0.1, 0.1, 0.2)), (lamp,))
    first = relighter.colors(mesh, EYE, lighting)
    relighter.colors(turned(mesh, 20)[0], EYE, Lighting(uniform((1, 1, 1))))
    np.testing.assert_array_equal(relighter.colors(mesh, EYE, lighting), first)
    np.testing.assert_array_equal(Relighter(relighter.avatar).colors(mesh, EYE, lighting), first)


def test_recorded_and_mix(relighter):
    """Catches a mix in display values, and modes that are exchanged."""
    sun = Light("sun", np.array([3.0, 2.0, 1.0]), direction=(1, 0, 0))
    mesh, lighting = relighter.avatar.neutral, Lighting(uniform((0.1, 0.02, 0.02)), (sun,))
    sh = relighter.avatar.splats.sh
    recorded = relighter.colors(mesh, EYE, replace(lighting, mode="recorded"))
    np.testing.assert_allclose(recorded, sh_color(sh, np.tile(EYE, (len(sh), 1))), atol=1e-5)
    scene = relighter.colors(mesh, EYE, lighting)
    half = relighter.colors(mesh, EYE, replace(lighting, mode="mix", mix=0.25))
    np.testing.assert_allclose(
        srgb_to_linear(half),
        0.25 * srgb_to_linear(scene) + 0.75 * srgb_to_linear(recorded),
        rtol=1e-3,
        atol=1e-4,
    )


def test_the_captures_own_light_gives_back_what_was_recorded(relighter, monkeypatch):
    """Catches light that is taken away otherwise than it is given: bounce, occlusion, exposure,
    white; also where nothing of the recorded colors is kept."""
    monkeypatch.setattr(relight, "UNLIKE_LIGHT", 1e-12)
    own = Lighting(relighter.light.radiance)
    lit = relighter.radiance(relighter.avatar.neutral, EYE, own)
    recorded = relighter.radiance(relighter.avatar.neutral, EYE, replace(own, mode="recorded"))
    open_ = relighter.light.occlusion[relighter.corners].min(1) > 0.5
    facing = normals_of(relighter)
    seen = open_ & (facing[:, 2] > 0.8)
    np.testing.assert_allclose(lit[seen], recorded[seen], rtol=0.06)
    bright = relighter.radiance(
        relighter.avatar.neutral, EYE, replace(own, exposure=1.0, white=(1.0, 2.0, 0.5))
    )
    np.testing.assert_allclose(bright, lit * np.float32([2, 1, 4]), rtol=1e-5)


def test_color_that_depends_on_the_view_is_no_albedo():
    """Catches highlights that were baked into harmonics and would stay where the recorded light put
    them."""
    plain, glossy = lit_avatar(ALBEDO), lit_avatar(ALBEDO, degree=1)
    normals = Relighter(plain).avatar.frames(plain.neutral).rotation[:, :, 2]
    sh = glossy.splats.sh.copy()
    straight_on = np.stack([normals[:, 1], -normals[:, 2], normals[:, 0]], axis=1)
    sh[:, 1:] = 0.2 * straight_on[..., None]
    glossy = replace(glossy, splats=replace(glossy.splats, sh=sh))
    seen_straight = sh_color(sh, -normals) - sh_color(plain.splats.sh, -normals)
    mean = Relighter(glossy).diffuse_color - Relighter(plain).diffuse_color
    assert seen_straight.mean() > 0.05
    assert np.std(mean) < 0.3 * seen_straight.mean()
    assert (mean < seen_straight).all()


def test_recorded_color_is_a_mean_over_the_directions_that_see_a_splat():
    """Catches a factor of a degree, or a direction, that is not that of the mean: against sampled
    directions."""
    avatar = lit_avatar(ALBEDO, degree=3)
    sh = np.random.default_rng(0).normal(0, 0.1, avatar.splats.sh.shape).astype(np.float32)
    relighter = Relighter(replace(avatar, splats=replace(avatar.splats, sh=sh)))
    mesh = avatar.neutral.astype(np.float64)
    normals = np.einsum(
        "nk,nkc->nc", relighter.weights, vertex_normals(mesh, avatar.faces)[relighter.corners]
    )[:40]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = even_directions(4000)
    for normal, coefficients, found in zip(normals, sh, relighter.diffuse_color, strict=False):
        seen = directions[directions @ normal > 0.3]
        colors = sh_color(np.broadcast_to(coefficients, (len(seen), *coefficients.shape)), -seen)
        np.testing.assert_allclose(found, colors.mean(0), atol=1e-3)


def test_an_avatar_without_light_says_so():
    """Catches a traceback where the light was never estimated."""
    with pytest.raises(StgaError, match="stga relight"):
        Relighter(replace(lit_avatar(ALBEDO), light=None))
