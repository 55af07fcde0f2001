"""Local frames against a plain per-triangle computation; `tests/numerics/test_meshes.py` has
triangles without area, and quaternions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import (
    CONVENTIONS,
    WORLD,
    face_areas,
    face_frames,
    frame_backward,
    placed,
    to_local,
    to_world,
)
from stga_addon.avatar.splats import sh_color

from .conftest import random_mesh, random_splats


def unit(v):
    return v / np.sqrt(v @ v)


def heron(p, q, r):
    a, b, c = (np.sqrt(((u - v) ** 2).sum()) for u, v in ((p, q), (q, r), (r, p)))
    s = (a + b + c) / 2
    return float(np.sqrt(s * (s - a) * (s - b) * (s - c)))


def frame_by_hand(posed, neutral, convention):
    """Origin (3,), axes as columns (3, 3) and scale of one triangle (3, 3), as the two publications
    define them."""
    p, q, r = posed
    center = (p + q + r) / 3
    normal = unit(np.cross(q - p, r - p))
    if convention == "stga":
        first = unit(p - center)
        scale = np.sqrt(heron(*posed) / heron(*neutral))
        return center, np.column_stack([first, np.cross(normal, first), normal]), scale
    first = unit(q - p)
    third = np.cross(first, normal)
    scale = (np.sqrt((q - p) @ (q - p)) + abs(third @ (r - p))) / 2
    return center, np.column_stack([first, normal, third]), scale


def scipy_rotation(wxyz):
    return Rotation.from_quat(wxyz[..., [1, 2, 3, 0]])


def covariance(splats):
    axes = scipy_rotation(splats.rotation).as_matrix() * np.exp(splats.log_scale)[:, None]
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_frames_are_the_published_ones(convention):
    """Catches swapped axes, a flipped normal, a scale of the wrong kind, or half an area, triangle
    by triangle."""
    neutral, faces = random_mesh(0)
    posed = random_mesh(1)[0]
    frames = face_frames(posed, faces, neutral, convention)
    for i, corners in enumerate(faces):
        origin, axes, scale = frame_by_hand(posed[corners], neutral[corners], convention)
        assert_allclose(frames.origin[i], origin, atol=1e-12)
        assert_allclose(frames.rotation[i], axes, atol=1e-9)
        assert frames.scale[i] == pytest.approx(scale, rel=1e-6)
        assert face_areas(neutral, faces)[i] == pytest.approx(heron(*neutral[corners]), rel=1e-6)
    rotation = scipy_rotation(frames.quaternion).as_matrix()
    assert_allclose(rotation, frames.rotation, atol=1e-12)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_world_covariance_is_the_transformed_local_one(convention):
    """Catches quaternions multiplied in the wrong order, scale applied to the variance instead of
    sigma, a change of what does not depend on the frame, and an inverse that is not one."""
    neutral, faces = random_mesh(0)
    frames = face_frames(random_mesh(1)[0], faces, neutral, convention)
    splats = random_splats(3, 40, len(faces))
    world = to_world(splats, frames)

    linear = frames.rotation[splats.face] * frames.scale[splats.face, None, None]
    expected = linear @ covariance(splats) @ linear.transpose(0, 2, 1)
    atol = 1e-6 * np.abs(expected).max()
    assert_allclose(covariance(world), expected, rtol=1e-4, atol=atol)
    positions = np.einsum("nij,nj->ni", linear, splats.xyz) + frames.origin[splats.face]
    assert_allclose(world.xyz, positions, atol=1e-6)
    for name in ("opacity", "sh", "unbound"):
        assert_array_equal(getattr(world, name), getattr(splats, name))
    back = to_local(world, frames, splats.face)
    assert_allclose(back.xyz, splats.xyz, atol=2e-6 / frames.scale.min())
    assert_allclose(back.log_scale, splats.log_scale, atol=2e-6)
    found, expected = (scipy_rotation(s.rotation).as_matrix() for s in (back, splats))
    assert_allclose(found, expected, atol=2e-6)
    assert_array_equal(back.face, splats.face)


def test_world_frame_changes_nothing():
    """Catches world-space sets that drift, 0/0 of a zero quaternion, and a misspelt convention."""
    splats = random_splats(5, 20, 1)
    splats.rotation[0] = 0
    world = to_world(splats, WORLD)
    assert_array_equal(world.xyz, splats.xyz)
    assert_array_equal(world.log_scale, splats.log_scale)
    assert_array_equal(world.rotation[0], [1, 0, 0, 0])
    with pytest.raises(ValueError, match="gaussian-avatars"):
        face_frames(*random_mesh(0), random_mesh(0)[0], "gaussian-avatars")


def test_backward_agrees_with_differences():
    """Catches a gradient that leaves out what turns or grows a triangle, takes an edge for another,
    or has a wrong sign: against central differences of the frames in random directions."""
    vertices, faces = random_mesh(4)
    rng = np.random.default_rng(5)
    neutral = vertices + rng.normal(0, 0.01, vertices.shape)
    given = rng.normal(size=(len(faces), 7))
    frames = face_frames(vertices, faces, neutral)
    found = frame_backward(vertices, faces, frames, given)
    step = 1e-7
    for _ in range(3):
        direction = rng.normal(size=vertices.shape)
        ends = (vertices + sign * step * direction for sign in (1, -1))
        after, before = (face_frames(end, faces, neutral) for end in ends)
        away = after.origin - before.origin
        turn = after.rotation - before.rotation
        moved = np.einsum("fji,fj->fi", frames.rotation, away / (2 * step))
        spun = np.einsum("fji,fjk->fik", frames.rotation, turn / (2 * step))
        # of a skew-symmetric matrix
        turned = np.stack([spun[:, 2, 1], spun[:, 0, 2], spun[:, 1, 0]], -1)
        grown = np.log(after.scale / before.scale) / (2 * step)
        expected = (given * np.column_stack([moved, turned, grown])).sum()
        assert (found * direction).sum() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("kind", ["scaled", "mirrored", "sheared"])
def test_splats_are_placed_by_any_matrix(kind):
    """Catches ellipsoids and colors that do not turn, scale, mirror or shear with their place."""
    turn = Rotation.from_euler("xyz", (0.4, -1.1, 2.0)).as_matrix()
    change = {
        "scaled": 2 * np.eye(3),
        "mirrored": np.diag([0.5, 0.5, -0.5]),
        "sheared": np.array([[1, 0.5, 0], [0, 2, 0], [0, 0, -0.5]]),
    }
    matrix = np.eye(4)
    linear = matrix[:3, :3] = turn @ change[kind]
    matrix[:3, 3] = 1, 2, 3
    splats = random_splats(1, 40, 1)
    found = placed(splats, matrix)
    expected = linear @ covariance(splats) @ linear.T
    size = np.abs(expected).max((1, 2), keepdims=True)
    assert_allclose(covariance(found) / size, expected / size, atol=1e-5)
    assert_allclose(found.xyz, splats.xyz @ linear.T + [1, 2, 3], atol=1e-6)
    left, _, right = np.linalg.svd(linear)
    seen = np.random.default_rng(0).normal(size=(40, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    own = sh_color(splats.sh, seen @ (left @ right))
    assert_allclose(sh_color(found.sh, seen), own, atol=1e-5)
