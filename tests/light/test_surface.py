"""Where splats are on the mesh, against trimesh's nearest points."""

from dataclasses import replace

import numpy as np
import trimesh

from light.scenes import lit_avatar
from stga_addon.light.surface import surface_points


def test_splats_are_at_the_nearest_point_of_the_mesh():
    """Catches splats that stay in a triangle that they have left, walk away from themselves, or are lit on the wrong
    corner's side; and a walk that leaves the mesh at its border."""
    avatar = lit_avatar()
    rng = np.random.default_rng(0)
    ball = avatar.faces[np.linalg.norm(avatar.neutral[avatar.faces].mean(1), axis=1) < 0.101]
    ball = ball[avatar.neutral[ball].mean(1)[:, 2] > -0.07]  # with a border
    xyz = (rng.normal(0, 1, (len(ball), 3)) * [1.0, 1.0, 0.1]).astype(np.float32)
    splats = replace(avatar.splats.rows(np.arange(len(ball))), xyz=xyz, face=np.arange(len(ball), dtype=np.int32))
    avatar = replace(avatar, splats=splats, faces=ball)
    frames = avatar.frames(avatar.neutral)
    points = frames.origin + frames.scale[:, None] * np.einsum("nij,nj->ni", frames.rotation, xyz)
    face, weights = surface_points(avatar)
    corners = ball[face]
    found = np.einsum("nk,nkc->nc", weights, avatar.neutral[corners])
    mesh = trimesh.Trimesh(avatar.neutral, ball, process=False)
    _, least, _ = trimesh.proximity.closest_point_naive(mesh, points)
    away = np.linalg.norm(found - points, axis=1)
    own = np.linalg.norm(avatar.neutral[ball].mean(1) - points, axis=1)
    assert (corners != ball).any(1).mean() > 0.5
    assert (away < 1.2 * least + 1e-4).mean() > 0.95
    assert (away <= own + 1e-9).all()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
