"""Shadows of lashes: splats that stand off the mesh beside an eyeball."""

from dataclasses import replace

import numpy as np
import trimesh
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal

from light.scenes import blocked, lit_avatar, middle_splats
from stga_addon.avatar.file import Avatar, AvatarLight
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light.harmonics import uniform
from stga_addon.light.relight import Relighter
from stga_addon.light.surface import surface_points, transfer_of
from stga_addon.light.values import HAIR_ROUGHNESS, Light, Lighting
from stga_addon.scene.gpu.packing import relit_scene
from stga_addon.scene.layers import Relit, SceneLayer

EYE_RADIUS = 0.012
LID_HEIGHT = 0.016
EYE = np.array([0.0, 0.0, 1.0])
SUN = Light("sun", np.full(3, 3.0), direction=(0, -1, 0))


def eye_below_a_lid():
    """An eyeball around the origin, and behind it a small plate at LID_HEIGHT whose normal is y."""
    ball = trimesh.creation.icosphere(4, EYE_RADIUS)
    place = trimesh.transformations.translation_matrix((0, 0.015, -0.004))
    lid = trimesh.creation.box((0.02, 0.002, 0.01), place)
    both = trimesh.util.concatenate([ball, lid.subdivide().subdivide()])
    return np.array(both.vertices), np.array(both.faces, np.int32)


def avatar_with(offset, color=0.05):
    """A gray splat in each triangle, and a card of 8 × 4 mm at `offset` from the lid's top."""
    vertices, faces = eye_below_a_lid()
    transfer, occlusion = transfer_of(vertices, faces, 64)
    irradiance = np.full((len(vertices), 3), np.pi, np.float32)
    wet = np.where(norm(vertices, axis=1) < 0.0121, 0.2, 0).astype(np.float32)
    radiance = uniform(np.ones(3)).astype(np.float32)
    light = AvatarLight(radiance, transfer, occlusion, irradiance, wet, 0.0)
    top = np.flatnonzero(vertices[faces][:, :, 1].min(1) > LID_HEIGHT - 1e-6)
    splats = middle_splats(np.append(np.arange(len(faces)), top[0]), -9)
    avatar = Avatar(splats, "stga", vertices.astype(np.float32), faces, light=light)
    frames = avatar.frames(vertices)
    place = np.array([0, LID_HEIGHT, 0]) + offset - frames.origin[top[0]]
    splats.xyz[-1] = frames.rotation[top[0]].T @ place
    # The axes of the card are x and z of the world: turned about the lid's normal from the
    # triangle's.
    axes = np.eye(4)
    axes[:3, :3] = frames.rotation[top[0]].T @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    splats.rotation[-1] = trimesh.transformations.quaternion_from_matrix(axes)
    splats.log_scale[-1] = np.log([0.004, 0.002, 0.0002])
    splats.sh[-1, 0] = (color - 0.5) / SH_C0
    return avatar


def test_a_lash_shades_the_eye_as_cast_rays_say():
    """Catches lashes without a shadow, at another place or size, or that do not follow."""
    relighter = Relighter(avatar_with((0, 0.003, 0.006)))
    assert len(relighter.lashes.face) == 1
    corners = np.array([[0.008, 0, 0], [0, 0, -0.004], [-0.008, 0, 0], [0, 0, 0.004]])
    ends = corners + np.array([0, LID_HEIGHT + 0.003, 0.006])
    for shift in (np.zeros(3), np.array([0.1, 0.05, -0.2])):
        mesh = relighter.avatar.neutral + shift
        cards = relighter.lash_casters(mesh, Lighting(lights=(SUN,)))[0]
        found = {tuple(np.round(corner, 6)) for corner in cards.vertices}
        assert found == {tuple(np.round(corner, 6)) for corner in ends + shift}
    avatar = relighter.avatar
    vertices = avatar.neutral.astype(np.float64)
    points = vertices[avatar.faces].mean(1)
    normals = vertex_normals(vertices, avatar.faces)[avatar.faces].mean(1)
    with_lid = np.concatenate([vertices, ends])
    faces = np.concatenate([avatar.faces, len(vertices) + np.array([[0, 1, 2], [0, 2, 3]])])
    up = normals[:, 1] > 0.5
    eye = np.flatnonzero(up & (norm(points, axis=1) < EYE_RADIUS))
    lifted = points[eye] + 0.001 * normals[eye]
    sunward = np.array([0.0, 1, 0])
    dark = blocked(lifted, sunward, with_lid, faces)
    alone = blocked(lifted, sunward, vertices, avatar.faces)
    assert 20 < (dark & ~alone).sum() < (~alone).sum() - 20
    lighting = Lighting(lights=(SUN,), specular=0)
    lit = relighter.radiance(vertices, EYE, lighting)[eye, 1]
    open_ = relighter.radiance(vertices, EYE, replace(lighting, shadows=False))[eye, 1]
    assert ((lit < 0.5 * open_) == dark).mean() > 0.9  # but for the soft edge
    assert (lit[dark & ~alone] < 0.5 * open_[dark & ~alone]).mean() > 0.9


def test_the_viewport_draws_lashes_into_its_shadow_maps():
    """Catches a viewport whose lashes throw no shadow while a rendered image's do."""
    avatar = avatar_with((0, 0.003, 0.006))
    mesh = avatar.neutral.astype(np.float64) + 0.1
    relit = Relit(Relighter(avatar), mesh, Lighting(lights=(SUN,)))
    layer = SceneLayer(avatar.splats, avatar.frames(mesh), np.eye(4), relit=relit)
    head, cards = relit_scene([layer]).maps[0].meshes
    assert head[0] is mesh
    assert_array_equal(cards[0], relit.relighter.lashes.caster(mesh).vertices)
    still = replace(relit, lighting=Lighting(lights=(SUN,), shadows=False))
    assert relit_scene([replace(layer, relit=still)]).maps == ()


def test_only_what_is_dark_and_stands_off_near_an_eye_is_a_lash():
    """Catches shadows of bright skin, of splats on the mesh, and of hair far from the eyes, and
    lashes that are not found where they darken the lids."""
    avatar = avatar_with((0, 0.003, 0.006))
    dry = replace(avatar.light, roughness=np.zeros_like(avatar.light.roughness))
    others = {
        "bright": avatar_with((0, 0.003, 0.006), color=0.7),
        "on the mesh": avatar_with((0, 0.001, 0.0)),
        "far": avatar_with((0, 0.03, 0.0)),
        "no eyes": replace(avatar, light=dry),
    }
    for name, other in others.items():
        assert not len(Relighter(other).lashes.face), name
    darkened = np.where(avatar.light.roughness > 0, avatar.light.roughness, HAIR_ROUGHNESS)
    on_dark = replace(avatar, light=replace(avatar.light, roughness=darkened))
    assert_array_equal(Relighter(on_dark).lashes.face, Relighter(avatar).lashes.face)


def test_splats_are_at_the_nearest_point_of_the_mesh():
    """Catches splats that stay in a triangle they have left, or walk away or off the border."""
    avatar = lit_avatar()
    rng = np.random.default_rng(0)
    ball = avatar.faces[norm(avatar.neutral[avatar.faces].mean(1), axis=1) < 0.101]
    ball = ball[avatar.neutral[ball].mean(1)[:, 2] > -0.07]  # with a border
    xyz = (rng.normal(0, 1, (len(ball), 3)) * [1.0, 1.0, 0.1]).astype(np.float32)
    splats = replace(middle_splats(np.arange(len(ball)), -6), xyz=xyz)
    avatar = replace(avatar, splats=splats, faces=ball)
    frames = avatar.frames(avatar.neutral)
    points = frames.origin + frames.scale[:, None] * np.einsum("nij,nj->ni", frames.rotation, xyz)
    face, weights = surface_points(avatar)
    corners = ball[face]
    found = np.einsum("nk,nkc->nc", weights, avatar.neutral[corners])
    mesh = trimesh.Trimesh(avatar.neutral, ball, process=False)
    _, least, _ = trimesh.proximity.closest_point_naive(mesh, points)
    away = norm(found - points, axis=1)
    own = norm(avatar.neutral[ball].mean(1) - points, axis=1)
    assert (corners != ball).any(1).mean() > 0.5
    assert (away < 1.2 * least + 1e-4).mean() > 0.95
    assert (away <= own + 1e-9).all()
    assert_allclose(weights.sum(1), 1, atol=1e-6)
