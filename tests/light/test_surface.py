"""Where splats lie on the mesh, against trimesh's nearest points; transfer and occlusion, against cast rays."""

from dataclasses import replace

import numpy as np
import trimesh

from light.scenes import ball_and_plate, blocked, lit_avatar
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light.harmonics import LAMBERT, basis, even_directions
from stga_addon.light.lamps import LIFT_M
from stga_addon.light.surface import surface_points, transfer_of


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
    corners, weights = surface_points(avatar)
    found = np.einsum("nk,nkc->nc", weights, avatar.neutral[corners])
    mesh = trimesh.Trimesh(avatar.neutral, ball, process=False)
    _, least, _ = trimesh.proximity.closest_point_naive(mesh, points)
    away = np.linalg.norm(found - points, axis=1)
    own = np.linalg.norm(avatar.neutral[ball].mean(1) - points, axis=1)
    assert (corners != ball).any(1).mean() > 0.5
    assert (away < 1.2 * least + 1e-4).mean() > 0.95
    assert (away <= own + 1e-9).all()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)


def test_transfer_and_occlusion_are_those_of_cast_rays():
    """Catches depth maps that are mirrored, too coarse, or that let the surface shade itself."""
    vertices, faces = ball_and_plate(2)
    transfer, occlusion = transfer_of(vertices, faces, directions=48)
    normals, sky = vertex_normals(vertices, faces), even_directions(48)
    points = vertices + LIFT_M * normals
    seen = np.stack([~blocked(points, direction, vertices, faces) for direction in sky])
    cosine = np.maximum(sky @ normals.T, 0)
    expected = (seen * cosine).T @ basis(sky) * 4 * np.pi / len(sky)
    np.testing.assert_allclose(occlusion, (seen * cosine).sum(0) / cosine.sum(0), atol=0.12)
    assert np.abs(occlusion - (seen * cosine).sum(0) / cosine.sum(0)).mean() < 0.008
    assert np.abs(transfer - expected).mean() < 0.01
    assert occlusion[:162].min() < 0.7, "the plate hides no sky"


def test_an_open_surface_receives_the_closed_form():
    """Catches harmonics of another order or sign, and a wrong solid angle."""
    vertices, faces = ball_and_plate(3)
    transfer, occlusion = transfer_of(vertices, faces)
    normals = vertex_normals(vertices, faces)
    below = (normals[:, 1] < -0.3) & (np.linalg.norm(vertices, axis=1) < 0.1001)
    assert below.sum() > 100
    np.testing.assert_allclose(transfer[below], basis(normals[below]) * LAMBERT, atol=0.03)
    np.testing.assert_allclose(occlusion[below], 1, atol=0.01)
