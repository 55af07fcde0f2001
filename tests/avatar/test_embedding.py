"""Local frames against a plain per-triangle computation, and quaternions against scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import (
    CONVENTIONS,
    WORLD,
    face_areas,
    face_frames,
    frame_backward,
    to_local,
    to_world,
)
from stga_addon.flame.quaternions import from_matrices

from .conftest import random_mesh, random_splats


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.sqrt(v @ v)


def heron(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> float:
    a, b, c = (np.sqrt(((u - v) ** 2).sum()) for u, v in ((p, q), (q, r), (r, p)))
    s = (a + b + c) / 2
    return float(np.sqrt(s * (s - a) * (s - b) * (s - c)))


def frame_by_hand(
    posed: np.ndarray, neutral: np.ndarray, convention: str
) -> tuple[np.ndarray, np.ndarray, float]:
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


def scipy_rotation(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(wxyz[..., [1, 2, 3, 0]])


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_frames_are_the_published_ones(convention):
    """Catches swapped axes, a flipped normal, or a scale of the wrong kind, triangle by
    triangle."""
    neutral, faces = random_mesh(0)
    posed = random_mesh(1)[0]
    frames = face_frames(posed, faces, neutral, convention)
    for i, corners in enumerate(faces):
        origin, axes, scale = frame_by_hand(posed[corners], neutral[corners], convention)
        np.testing.assert_allclose(frames.origin[i], origin, atol=1e-12)
        np.testing.assert_allclose(frames.rotation[i], axes, atol=1e-9)
        assert frames.scale[i] == pytest.approx(scale, rel=1e-6)
    rotation = scipy_rotation(frames.quaternion).as_matrix()
    np.testing.assert_allclose(rotation, frames.rotation, atol=1e-12)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_splats_follow_a_rigid_motion_and_a_scaling(convention):
    """Catches embedding that is not equivariant: similar meshes must carry similar splats."""
    neutral, faces = random_mesh(0)
    splats = random_splats(2, 40, len(faces))
    turn, shift, size = Rotation.from_rotvec([0.3, -1.1, 2.0]), np.array([0.5, -0.2, 1.0]), 1.7
    before = to_world(splats, face_frames(neutral, faces, neutral, convention))
    moved = size * turn.apply(neutral) + shift
    after = to_world(splats, face_frames(moved, faces, neutral, convention))
    np.testing.assert_allclose(after.xyz, size * turn.apply(before.xyz) + shift, atol=2e-6)
    np.testing.assert_allclose(after.log_scale, before.log_scale + np.log(size), atol=2e-6)
    expected = (turn * scipy_rotation(before.rotation)).as_matrix()
    np.testing.assert_allclose(scipy_rotation(after.rotation).as_matrix(), expected, atol=2e-6)
    for name in ("opacity", "sh", "unbound"):
        np.testing.assert_array_equal(getattr(after, name), getattr(splats, name))


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_world_covariance_is_the_transformed_local_one(convention):
    """Catches quaternions multiplied in the wrong order, or scale applied to the variance instead
    of sigma."""
    neutral, faces = random_mesh(0)
    frames = face_frames(random_mesh(1)[0], faces, neutral, convention)
    splats = random_splats(3, 40, len(faces))
    world = to_world(splats, frames)

    def covariance(s) -> np.ndarray:
        axes = scipy_rotation(s.rotation).as_matrix() * np.exp(s.log_scale)[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    linear = frames.rotation[splats.face] * frames.scale[splats.face, None, None]
    expected = linear @ covariance(splats) @ linear.transpose(0, 2, 1)
    atol = 1e-6 * np.abs(expected).max()
    np.testing.assert_allclose(covariance(world), expected, rtol=1e-4, atol=atol)
    positions = np.einsum("nij,nj->ni", linear, splats.xyz) + frames.origin[splats.face]
    np.testing.assert_allclose(world.xyz, positions, atol=1e-6)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_world_and_back_is_the_same_splat(convention):
    """Catches an inverse that is not one."""
    neutral, faces = random_mesh(0)
    frames = face_frames(random_mesh(1)[0], faces, neutral, convention)
    splats = random_splats(4, 40, len(faces))
    back = to_local(to_world(splats, frames), frames, splats.face)
    smallest = frames.scale.min()
    np.testing.assert_allclose(back.xyz, splats.xyz, atol=2e-6 / smallest)
    np.testing.assert_allclose(back.log_scale, splats.log_scale, atol=2e-6)
    found, expected = (scipy_rotation(s.rotation).as_matrix() for s in (back, splats))
    np.testing.assert_allclose(found, expected, atol=2e-6)
    np.testing.assert_array_equal(back.face, splats.face)


def test_world_frame_changes_nothing():
    """Catches world-space sets that drift when they pass through the same code as embedded ones."""
    splats = random_splats(5, 20, 1)
    world = to_world(splats, WORLD)
    np.testing.assert_array_equal(world.xyz, splats.xyz)
    np.testing.assert_array_equal(world.log_scale, splats.log_scale)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize(
    "corners",
    [
        [[1, 2, 3], [1, 2, 3], [1, 2, 3]],
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 1, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[0, 0, 0], [1e-20, 0, 0], [0, 1e-20, 0]],
    ],
    ids=["point", "line", "first edge empty", "last edge empty", "tiny"],
)
def test_triangle_without_area_keeps_a_proper_frame(convention, corners):
    """Catches NaN rotations from collapsed triangles, posed or already in the neutral mesh."""
    faces = np.array([[0, 1, 2]])
    flat, whole = np.array(corners, float), np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    for posed, neutral in ((flat, whole), (whole, flat), (flat, flat)):
        frames = face_frames(posed, faces, neutral, convention)
        np.testing.assert_allclose(frames.rotation[0].T @ frames.rotation[0], np.eye(3), atol=1e-9)
        assert np.linalg.det(frames.rotation[0]) == pytest.approx(1)
        assert np.isfinite(frames.scale).all()
        world = to_world(random_splats(6, 5, 1), frames)
        local = to_local(world, frames, np.zeros(5, np.int32))
        for splats in (world, local):
            for name in ("xyz", "rotation", "log_scale"):
                assert np.isfinite(getattr(splats, name)).all(), name


def test_areas_are_herons():
    """Catches a forgotten half."""
    neutral, faces = random_mesh(7)
    expected = [heron(*neutral[f]) for f in faces]
    np.testing.assert_allclose(face_areas(neutral, faces), expected, rtol=1e-6)


def test_quaternion_of_any_rotation_is_scipys():
    """Catches lost precision near half turns, where the trace is −1."""
    rng = np.random.default_rng(9)
    axes = rng.normal(size=(200, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    axes[:3], axes[3:6] = np.eye(3), -np.eye(3)
    angles = [np.full(50, np.pi), np.pi - rng.exponential(1e-7, 50), rng.uniform(0, np.pi, 100)]
    rotation = Rotation.from_rotvec(axes * np.concatenate(angles)[:, None])
    quaternion = from_matrices(rotation.as_matrix())
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=-1), 1, atol=1e-12)
    assert (quaternion[:, 0] >= 0).all()
    found = scipy_rotation(quaternion).as_matrix()
    np.testing.assert_allclose(found, rotation.as_matrix(), atol=1e-12)


def test_zero_quaternion_counts_as_no_rotation():
    """Catches 0/0 when an optimizer, or a foreign file, delivers a zero quaternion."""
    splats = random_splats(10, 3, 1)
    splats.rotation[:] = 0
    np.testing.assert_array_equal(to_world(splats, WORLD).rotation, np.tile([1, 0, 0, 0], (3, 1)))


def test_unknown_convention_is_refused():
    """Catches a misspelt convention that would silently train in another frame."""
    with pytest.raises(ValueError, match="gaussian-avatars"):
        face_frames(*random_mesh(0), random_mesh(0)[0], "gaussian-avatars")


@pytest.mark.parametrize("part", ["force", "torque", "growth"])
def test_backward_agrees_with_differences(part: str) -> None:
    """Catches a gradient that leaves out what turns or grows a triangle, takes an edge for another,
    or has a wrong sign: against central differences of the frames in random directions."""
    vertices, faces = random_mesh(4)
    rng = np.random.default_rng(5)
    neutral = vertices + rng.normal(0, 0.01, vertices.shape)
    given = np.zeros((len(faces), 7))
    columns = {"force": slice(0, 3), "torque": slice(3, 6), "growth": slice(6, 7)}[part]
    given[:, columns] = rng.normal(size=given[:, columns].shape)
    frames = face_frames(vertices, faces, neutral)
    found = frame_backward(vertices, faces, frames, given)
    step = 1e-7
    for _ in range(3):
        direction = rng.normal(size=vertices.shape)
        ends = (vertices + sign * step * direction for sign in (1, -1))
        after, before = (face_frames(end, faces, neutral) for end in ends)
        away, turn = after.origin - before.origin, after.rotation - before.rotation
        moved = np.einsum("fji,fj->fi", frames.rotation, away / (2 * step))
        spun = np.einsum("fji,fjk->fik", frames.rotation, turn / (2 * step))
        # of a skew-symmetric matrix
        turned = np.stack([spun[:, 2, 1], spun[:, 0, 2], spun[:, 1, 0]], -1)
        grown = np.log(after.scale / before.scale) / (2 * step)
        changes = {"force": moved, "torque": turned, "growth": grown}
        expected = (given[:, columns] * changes[part].reshape(len(faces), -1)).sum()
        assert (found * direction).sum() == pytest.approx(expected, rel=1e-5)
