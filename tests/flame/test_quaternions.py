"""Rotations as quaternions."""

import numpy as np
from scipy.spatial.transform import Rotation

from stga_addon.flame.quaternions import to_matrices


def test_matrices_are_those_of_scipy():
    """Catches a transposed matrix, another order of components, and lengths that scale what is rotated."""
    quaternions = np.random.default_rng(0).normal(size=(4, 5, 4))
    expected = Rotation.from_quat(np.roll(quaternions, -1, axis=-1).reshape(-1, 4)).as_matrix()
    np.testing.assert_allclose(to_matrices(quaternions).reshape(-1, 3, 3), expected, atol=1e-12)
    np.testing.assert_array_equal(to_matrices(np.zeros(4)), np.eye(3))
