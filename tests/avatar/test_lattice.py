"""Initial splats: how many, where, how large; `tests/numerics/test_meshes.py` has triangles without
area."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.embedding import CONVENTIONS, face_frames, to_world
from stga_addon.avatar.lattice import lattice_splats

from .conftest import random_mesh
from .test_embedding import covariance


@pytest.mark.parametrize(("order", "count"), [(0, 1), (1, 3), (2, 6), (3, 10), (4, 15)])
def test_points_a_triangle(order, count):
    """Catches a lattice that repeats or forgets points, mixes up the order of triangles, or starts
    with another color or opacity than gray and half transparent."""
    neutral, faces = random_mesh(0)
    splats = lattice_splats(neutral, faces, order, sh_degree=2)
    assert len(splats) == count * len(faces)
    assert splats.sh.shape[1:] == (9, 3)
    assert not any(values.any() for values in (splats.sh, splats.opacity, splats.unbound))
    assert_array_equal(splats.face, np.repeat(np.arange(len(faces)), count))
    assert len(np.unique(splats.xyz[:count].round(6), axis=0)) == count
    assert splats.face.dtype == np.int32
    for name in ("xyz", "rotation", "log_scale", "opacity", "sh"):
        assert getattr(splats, name).dtype == np.float32, name


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_order_4_is_the_corners_and_midpoints_of_the_four_subtriangles(convention):
    """Catches wrong barycentric weights, a local frame that does not bring the points back onto the
    triangle, and points of two triangles that coincide on their common edge."""
    neutral, faces = random_mesh(1)
    splats = lattice_splats(neutral, faces, 4, convention=convention)
    world = to_world(splats, face_frames(neutral, faces, neutral, convention)).xyz.reshape(
        len(faces), 15, 3
    )
    for points, corners in zip(world, neutral[faces], strict=True):
        ends = np.concatenate([corners, (corners + np.roll(corners, 1, axis=0)) / 2])
        # midpoints of any two ends of the four triangles are on one of their edges, or at its end
        expected = 0.9 * (ends[:, None] + ends).reshape(-1, 3) / 2 + 0.1 * corners.mean(0)
        distance = np.linalg.norm(points[:, None] - expected, axis=-1)
        assert distance.min(0).max() < 1e-7
        assert distance.min(1).max() < 1e-7


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_world_scale_is_flat_along_the_normal(convention):
    """Catches triangle units taken for meters, and flattening along another axis."""
    neutral, faces = random_mesh(2)
    splats = lattice_splats(neutral, faces, 2, convention=convention)
    world = to_world(splats, face_frames(neutral, faces, neutral, convention))
    normal = np.cross(*(neutral[faces[:, i]] - neutral[faces[:, 0]] for i in (1, 2)))
    twice_area = np.linalg.norm(normal, axis=1)[:, None, None]
    flat = np.eye(3) - 0.75 * normal[:, :, None] * normal[:, None] / twice_area**2
    expected = np.repeat(0.6**2 * twice_area / 4 * flat, 6, axis=0)
    assert_allclose(covariance(world), expected, atol=1e-5 * expected.max())
