"""Relit colors of an avatar whose truth is known, a ball of one albedo under a plate."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from light.scenes import lit_avatar
from stga_addon.avatar.splats import sh_color
from stga_addon.capture.color import srgb_to_linear
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light import relight
from stga_addon.light.estimate import roughness_of
from stga_addon.light.harmonics import basis, even_directions, rotated, uniform
from stga_addon.light.relight import Relighter, kept, kept_fractions
from stga_addon.light.values import Light, Lighting

EYE = np.array([0.0, 0.0, 1.0])
ALBEDO = (0.5, 0.3, 0.2)
TINT = np.array([1.4, 1.0, 0.6])


@pytest.fixture(scope="module")
def relighter():
    return Relighter(lit_avatar(ALBEDO))


def turned(mesh, degrees):
    """The mesh turned about y and moved; and the rotation."""
    rotation = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return mesh @ rotation.T + [0.3, 0.1, -0.2], rotation


def test_albedo_is_what_was_recorded_without_its_light(relighter):
    """Catches highlights in the albedo, and units other than Blender's: albedo E / π."""
    lit = relighter.light.occlusion[relighter.corners].min(1) > 0.3
    assert_allclose(relighter.albedo[lit], np.tile(ALBEDO, (lit.sum(), 1)), rtol=0.02)
    sun = Light("sun", np.array([2.0, 2.0, 2.0]), direction=(0, 1, 0))
    lit = relighter.radiance(relighter.avatar.neutral, EYE, Lighting(lights=(sun,), specular=0))
    normals = normals_of(relighter)
    radius = np.linalg.norm(relighter.avatar.neutral[relighter.corners[:, 0]], axis=1)
    down = (normals[:, 1] < -0.3) & (radius < 0.101)
    assert down.sum() > 100
    expected = np.array(ALBEDO) * 2 * -normals[down, 1:2] / np.pi
    assert_allclose(lit[down], expected, rtol=0.03, atol=0.004)


def test_hair_does_not_shine_as_skin_does():
    """Catches hair that a lamp behind the head whitens, eyes that are found in it, and skin beside
    it that shines like eyes."""
    avatar = lit_avatar(ALBEDO)
    above = avatar.neutral[:, 1] > 0
    is_hair = above[avatar.faces].all(1)
    roughness = roughness_of(avatar.neutral, avatar.faces, is_hair)
    relighter = Relighter(replace(avatar, light=replace(avatar.light, roughness=roughness)))
    assert set(relighter.roughness) == {0.0, 1.0}
    assert (relighter.roughness[is_hair] == 1).mean() > 0.9
    assert (relighter.roughness[~is_hair] == 0).all()
    assert_allclose(relighter.albedo, Relighter(avatar).albedo)
    assert not len(relighter.lashes.face)
    lamp = Light("sun", np.full(3, 5.0), direction=(1.0, 0.0, 0.4), casts_shadow=False)
    with_shine, without = (
        relighter.radiance(avatar.neutral, EYE, Lighting(lights=(lamp,), specular=specular))
        for specular in (1.0, 0.0)
    )
    shine = (with_shine - without).max(1)
    is_dull = relighter.roughness == 1
    assert shine[is_dull].max() < 0.2 * shine[~is_dull].max()


def normals_of(relighter):
    """(N, 3) the neutral mesh's smooth normals at the splats."""
    mesh = relighter.avatar.neutral.astype(np.float64)
    faces = relighter.avatar.faces
    normals = vertex_normals(mesh, faces)[relighter.corners]
    normals = np.einsum("nk,nkc->nc", relighter.weights, normals)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_light_that_turns_with_the_head_changes_nothing(relighter):
    """Catches world light, highlights or shadows in the axes of another space than the head's."""
    mesh = relighter.avatar.neutral.astype(np.float64)
    moved, rotation = turned(mesh, 50)
    world = uniform((0.1, 0.2, 0.3))
    world[1:4] = [[0.05] * 3, [0.1] * 3, [-0.1] * 3]
    lamp = Light("point", np.array([20.0, 15.0, 10.0]), (0.4, 0.6, 0.3))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = [0.3, 0.1, -0.2]
    here = relighter.radiance(mesh, EYE, Lighting(world, (lamp,)))
    there_light = Lighting(rotated(world, rotation), (lamp.transformed(matrix),))
    there = relighter.radiance(moved, matrix[:3, :3] @ EYE + matrix[:3, 3], there_light)
    # the shadow map's texels lie elsewhere
    assert np.abs(here - there).mean() < 0.002 * here.mean() + 2e-3


def test_a_still_head_under_still_light_does_not_flicker(relighter):
    """Catches anything random, or a state that one frame leaves to the next."""
    lamp = Light("spot", np.ones(3) * 40, (0.2, 0.3, 0.8), direction=(-0.2, -0.3, -0.8))
    mesh = relighter.avatar.neutral
    lighting = Lighting(uniform((0.1, 0.1, 0.2)), (lamp,))
    first = relighter.colors(mesh, EYE, lighting)
    relighter.colors(turned(mesh, 20)[0], EYE, Lighting(uniform((1, 1, 1))))
    assert_array_equal(relighter.colors(mesh, EYE, lighting), first)
    assert_array_equal(Relighter(relighter.avatar).colors(mesh, EYE, lighting), first)


def test_recorded_and_mix(relighter):
    """Catches a mix in display values, and modes that are exchanged."""
    sun = Light("sun", np.array([3.0, 2.0, 1.0]), direction=(1, 0, 0))
    mesh = relighter.avatar.neutral
    lighting = Lighting(uniform((0.1, 0.02, 0.02)), (sun,))
    sh = relighter.avatar.splats.sh
    recorded = relighter.colors(mesh, EYE, replace(lighting, mode="recorded"))
    assert_allclose(recorded, sh_color(sh, np.tile(EYE, (len(sh), 1))), atol=1e-5)
    scene = relighter.colors(mesh, EYE, lighting)
    mixed = relighter.colors(mesh, EYE, replace(lighting, mode="mix", mix=0.25))
    expected = 0.25 * srgb_to_linear(scene) + 0.75 * srgb_to_linear(recorded)
    assert_allclose(srgb_to_linear(mixed), expected, rtol=1e-3, atol=1e-4)


def test_only_recorded_colors_follow_the_normals(relighter):
    """Catches the capture's light left in relit colors or lost in recorded ones."""
    mesh = relighter.avatar.neutral * [1.1, 0.8, 1.0]
    count = len(relighter.avatar.faces)
    rng = np.random.default_rng(5)
    names = ("strain_color", "normal_color")
    values = {n: rng.normal(0, 0.3, (count, 3, 3)).astype(np.float32) for n in names}
    ends = np.repeat([[-2.0, -0.05], [2.0, 0.03]], 3, axis=1).astype(np.float32)
    avatar = replace(relighter.avatar, strain_range=np.tile(ends, (count, 1, 1)))
    sun = Lighting(lights=(Light("sun", np.full(3, 3.0), direction=(1, 0, 0)),))
    assert not relighter.distant_in_head(mesh, sun)[1].fraction

    def colors(mode, *names):
        driven = replace(avatar, driven_offsets={name: values[name] for name in names})
        return Relighter(driven).colors(mesh, EYE, replace(sun, mode=mode))

    lit = colors("scene", *names)
    assert_array_equal(lit, colors("scene", "strain_color"))
    assert np.abs(lit - colors("scene")).mean() > 0.01
    recorded = colors("recorded")
    frames = replace(avatar, driven_offsets=values).frames(mesh)
    expected = np.maximum(recorded + frames.color[avatar.splats.face], 0)
    assert_allclose(colors("recorded", *names), expected, atol=1e-5)
    assert np.abs(expected - colors("recorded", "strain_color")).mean() > 0.01


def test_the_captures_own_light_gives_back_what_was_recorded(relighter, monkeypatch):
    """Catches light taken away otherwise than given: bounce, occlusion, exposure, white."""
    monkeypatch.setattr(relight, "UNLIKE_LIGHT", 1e-12)
    own = Lighting(relighter.light.radiance)
    mesh = relighter.avatar.neutral
    lit = relighter.radiance(mesh, EYE, own)
    recorded = relighter.radiance(mesh, EYE, replace(own, mode="recorded"))
    open_ = relighter.light.occlusion[relighter.corners].min(1) > 0.5
    seen = open_ & (normals_of(relighter)[:, 2] > 0.8)
    assert_allclose(lit[seen], recorded[seen], rtol=0.06)
    bright = relighter.radiance(mesh, EYE, replace(own, exposure=1.0, white=(1.0, 2.0, 0.5)))
    assert_allclose(bright, lit * np.float32([2, 1, 4]), rtol=1e-5)


def test_recorded_color_is_a_mean_over_the_directions_that_see_a_splat():
    """Catches highlights in harmonics that count as albedo: against sampled directions."""
    avatar = lit_avatar(ALBEDO, degree=3)
    sh = np.random.default_rng(0).normal(0, 0.1, avatar.splats.sh.shape).astype(np.float32)
    relighter = Relighter(replace(avatar, splats=replace(avatar.splats, sh=sh)))
    directions = even_directions(4000)
    rows = zip(normals_of(relighter)[:40], sh, relighter.diffuse_color, strict=False)
    for normal, coefficients, found in rows:
        seen = directions[directions @ normal > 0.3]
        colors = sh_color(np.broadcast_to(coefficients, (len(seen), *coefficients.shape)), -seen)
        assert_allclose(found, colors.mean(0), atol=1e-3)


def studio():
    """(9, 3) harmonics that are brighter from the front and above."""
    light = uniform((0.5, 0.45, 0.4))
    light[1:3] = [[0.3] * 3, [0.5, 0.4, 0.4]]
    return light


def relighter_of(light):
    """Of the ball as it would have been recorded in a light (9, 3)."""
    avatar = lit_avatar(degree=1)
    relighter = Relighter(avatar)
    arriving = avatar.light.transfer @ light
    arriving = (arriving + relighter.bounce.light(arriving)).astype(np.float32)
    avatar.splats.sh[:, 1:] = 0.05
    return Relighter(replace(avatar, light=replace(avatar.light, irradiance=arriving)))


def test_what_is_kept_of_recorded_colors():
    """Catches highlights, tint or studio that are lost or turn along under their own light, and
    recorded shades that stay or jump under another one."""
    relighter = relighter_of(studio())
    mesh = relighter.avatar.neutral.astype(np.float64)
    recorded = relighter.radiance(mesh, EYE, Lighting(mode="recorded"))
    tinted = relighter.radiance(mesh, EYE, Lighting(studio() * TINT))
    assert_allclose(tinted, recorded * TINT, rtol=0.03)
    aside, turn = turned(mesh, 90)
    along = Lighting(rotated(studio(), turn))
    there = relighter.radiance(aside, EYE, replace(along, mode="recorded"))
    assert_allclose(relighter.radiance(aside, EYE, along), there, rtol=0.03)
    assert share_kept(relighter, studio()) > 0.99
    assert relighter.distant_in_head(aside, Lighting(studio()))[1].fraction < 0.1
    assert_allclose(relighter.recorded_light, studio(), atol=0.01)
    lamps = [Light("sun", np.full(3, x), direction=(1, 0.2, 0)) for x in np.linspace(0, 3, 61)]
    shares = [share_kept(relighter, studio(), lamp) for lamp in lamps]
    steps = -np.diff(shares)
    assert shares[0] > 0.99
    assert shares[-1] == 0
    assert (steps >= 0).all()
    assert steps.max() < 0.1
    assert share_kept(relighter, studio(), specular=0.0) == 0
    assert share_kept(relighter, studio(), roughness=0.9) == 0


def share_kept(relighter, world, *lights, **options):
    lighting = Lighting(world, lights, **options)
    return relighter.distant_in_head(relighter.avatar.neutral, lighting)[1].fraction


def test_shadows_of_other_objects_stay():
    """Catches a shadow that vanishes because the light as a whole is the capture's."""
    same = kept(studio(), 2 * studio())
    irradiance = np.maximum(basis(np.eye(3)) @ studio(), 0.1).astype(np.float32)
    arriving = irradiance * np.float32([[2], [1.9], [0.3]])
    assert_allclose(kept_fractions(same, arriving, irradiance), [1, 1, 0], atol=1e-6)
