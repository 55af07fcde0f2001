"""A tiny head in FLAME's format, made of random numbers: no structure that a wrong index could hide
behind."""

import numpy as np
import pytest

from stga_addon.flame.forward import FlameFrame
from stga_addon.flame.model import FlameModel


def random_arrays(seed=0, vertices=40, components=12):
    """The arrays of a FLAME model file, at a head's scale in meters."""
    rng = np.random.default_rng(seed)
    weights = rng.random((vertices, 5)) ** 4
    regressor = rng.random((5, vertices)) * (rng.random((5, vertices)) < 0.4)
    regressor[:, 0] += 0.1
    return {
        "v_template": rng.normal(0, 0.08, (vertices, 3)),
        "shapedirs": rng.normal(0, 0.003, (vertices, 3, components)),
        "posedirs": rng.normal(0, 0.004, (vertices, 3, 36)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], range(5)], np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "f": rng.permuted(np.tile(np.arange(vertices), (70, 1)), axis=1)[:, :3].astype(np.uint32),
    }


def random_frame(seed, n_expression):
    """Large poses, so that a transposed rotation or a swapped joint is centimeters off."""
    rng = np.random.default_rng(seed)
    return FlameFrame(
        expr=rng.normal(size=n_expression),
        rotation=rng.normal(0, 0.7, 3),
        neck_pose=rng.normal(0, 0.4, 3),
        jaw_pose=rng.normal(0, 0.4, 3),
        translation=rng.normal(0, 0.2, 3),
        eyes_pose=rng.normal(0, 0.4, 6),
    )


def model_of(arrays, n_identity):
    """A FlameModel straight from arrays, without the reader that other tests put to the test."""
    return FlameModel(
        v_template=arrays["v_template"],
        shapedirs=arrays["shapedirs"],
        n_identity=n_identity,
        posedirs=arrays["posedirs"],
        j_regressor=arrays["J_regressor"],
        parents=np.array([-1, 0, 1, 1, 1]),
        weights=arrays["weights"],
        faces=arrays["f"].astype(np.int32),
    )


@pytest.fixture
def tiny_flame():
    return model_of(random_arrays(), n_identity=8)
