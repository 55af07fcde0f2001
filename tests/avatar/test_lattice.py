"""Initial splats: how many, where, how large."""

import numpy as np
import pytest

from stga_addon.avatar.embedding import CONVENTIONS, face_areas, face_frames, to_world
from stga_addon.avatar.lattice import lattice_splats

from .conftest import random_mesh


@pytest.mark.parametrize(("order", "count"), [(0, 1), (1, 3), (2, 6), (3, 10), (4, 15)])
def test_points_a_triangle(order, count):
    """Catches a lattice that repeats or forgets points, or mixes up the order of triangles."""
    neutral, faces = random_mesh(0)
    splats = lattice_splats(neutral, faces, order)
    assert len(splats) == count * len(faces)
    np.testing.assert_array_equal(splats.face, np.repeat(np.arange(len(faces)), count))
    assert len(np.unique(splats.xyz[:count].round(6), axis=0)) == count
    assert splats.face.dtype == np.int32
    for name in ("xyz", "rotation", "log_scale", "opacity", "sh"):
        assert getattr(splats, name).dtype == np.float32, name


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_order_4_is_the_corners_and_midpoints_of_the_four_subtriangles(convention):
    """Catches wrong barycentric weights and a local frame that does not bring the points back onto
    the triangle."""
    neutral, faces = random_mesh(1)
    splats = lattice_splats(neutral, faces, 4, convention=convention)
    world = to_world(splats, face_frames(neutral, faces, neutral, convention)).xyz.reshape(
        len(faces), 15, 3
    )
    for points, (a, b, c) in zip(world, neutral[faces], strict=True):
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = [a, b, c, ab, bc, ca]
        edges = [(a, ab), (ab, b), (b, bc), (bc, c), (c, ca), (ca, a), (ab, bc), (bc, ca), (ca, ab)]
        expected = (
            0.9 * np.array([*corners, *[(p + q) / 2 for p, q in edges]]) + 0.1 * (a + b + c) / 3
        )
        distance = np.linalg.norm(points[:, None] - expected[None], axis=-1)
        assert sorted(distance.argmin(1)) == list(range(15))
        assert distance.min(1).max() < 1e-7


def test_inset_keeps_neighbors_apart():
    """Catches points of two triangles that coincide on their common edge and would train as one."""
    neutral = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    splats = lattice_splats(neutral, faces, 2)
    world = to_world(splats, face_frames(neutral, faces, neutral)).xyz
    gap = np.linalg.norm(world[:6, None] - world[None, 6:], axis=-1).min()
    assert gap > 0.04
    inside = (world[:6, :2] > 0).all(1) & (world[:6, :2].sum(1) < 1)
    assert inside.all()


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_world_scale_is_flat_along_the_normal(convention):
    """Catches scale in the wrong unit (triangle units against meters) or flattened along the wrong
    axis."""
    neutral, faces = random_mesh(2)
    splats = lattice_splats(neutral, faces, 2, convention=convention)
    frames = face_frames(neutral, faces, neutral, convention)
    world = to_world(splats, frames)
    expected = 0.6 * np.sqrt(2 * face_areas(neutral, faces)) / 2
    normal = np.cross(*(neutral[faces[:, i]] - neutral[faces[:, 0]] for i in (1, 2)))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    # local axis that is the normal
    along = np.abs(np.einsum("fij,fi->fj", frames.rotation, normal)).argmax(1)
    sigma = np.exp(world.log_scale).reshape(len(faces), 6, 3)
    for face, axis in enumerate(along):
        want = np.full(3, expected[face])
        want[axis] *= 0.5
        np.testing.assert_allclose(sigma[face], np.tile(want, (6, 1)), rtol=1e-5)


def test_starts_gray_and_half_transparent():
    """Catches color or opacity initialized after, instead of before, activation."""
    splats = lattice_splats(*random_mesh(3), sh_degree=2)
    assert splats.sh.shape[1:] == (9, 3)
    assert not splats.sh.any()
    assert not splats.opacity.any()
    assert not splats.unbound.any()


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_triangle_without_area_gets_finite_splats(convention):
    """Catches the logarithm of zero on degenerate triangles, which tracked meshes do contain."""
    neutral = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], float)
    faces = np.array([[0, 1, 2], [1, 1, 1]], np.int32)
    splats = lattice_splats(neutral, faces, 2, convention=convention)
    for name in ("xyz", "rotation", "log_scale"):
        assert np.isfinite(getattr(splats, name)).all(), name
