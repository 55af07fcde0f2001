"""FLAME's forward pass against smplx's, its gradient against differences."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from stga_addon.flame.forward import (
    flame_forward,
    frame_of,
    parameters_gradient,
)
from stga_addon.flame.model import read_flame
from stga_addon.flame.quaternions import to_matrices

from .conftest import random_arrays, random_frame


def test_equals_smplx(tmp_path):
    """Catches disagreement with the reference FLAME of smplx: component layout, pose order, joints,
    correctives; and offsets that are dropped, or do not move joints as the template does.

    smplx_vertices.npy holds the vertices (50, 3) that `smplx.FLAME` of smplx 0.1.28 returned in
    float64 for the same random model, shape and frame (num_betas=300, num_expression_coeffs=100).
    """
    arrays = random_arrays(seed=11, vertices=50, components=400)
    arrays["shapedirs"] *= 0.2
    (tmp_path / "FLAME_NEUTRAL.pkl").write_bytes(pickle.dumps(arrays, protocol=2))
    model = read_flame(tmp_path / "FLAME_NEUTRAL.pkl")
    assert (model.n_identity, model.n_expression) == (300, 100)
    shape = default_rng(12).normal(size=300)
    frame = random_frame(13, 100)
    static, dynamic = default_rng(7).normal(0, 0.01, (2, 50, 3))
    less = replace(model, v_template=model.v_template - static - dynamic)
    ours = flame_forward(less, shape, replace(frame, dynamic_offset=dynamic), static)
    assert np.abs(ours - np.load(Path(__file__).with_name("smplx_vertices.npy"))).max() < 1e-5
    assert np.abs(ours - model.v_template).max() > 0.05  # the pose did something


STENCIL = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
"""Weights of central differences of the sixth order, which err by 1e-13 at steps of 0.01."""


@pytest.mark.parametrize("frame", [random_frame(8, 4), frame_of(np.zeros(22))])
def test_the_gradient_is_that_of_differences(tiny_flame, frame):
    """Catches a joint, a corrective or a joint's place left out, and 0/0 at an angle of zero."""
    offset, outer = default_rng(9).normal(0, 0.01, (2, 40, 3))
    person = replace(tiny_flame, v_template=tiny_flame.v_template + 0.01)
    shape = np.zeros(8)

    def along(step):
        moved = replace(frame_of(frame.parameters + step), dynamic_offset=offset)
        return (flame_forward(person, shape, moved) * outer).sum()

    expected = [
        sum(w * (along(k * step) - along(-k * step)) for k, w in STENCIL.items()) / 0.01
        for step in 0.01 * np.eye(22)
    ]
    found = parameters_gradient(person, replace(frame, dynamic_offset=offset), outer)
    assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_matrices_are_those_of_scipy():
    """Catches a transposed matrix, another order of components, and lengths that scale what is
    rotated."""
    quaternions = default_rng(0).normal(size=(4, 5, 4))
    expected = Rotation.from_quat(np.roll(quaternions, -1, axis=-1).reshape(-1, 4)).as_matrix()
    assert_allclose(to_matrices(quaternions).reshape(-1, 3, 3), expected, atol=1e-12)
    assert_array_equal(to_matrices(np.zeros(4)), np.eye(3))
