"""The public functions of `render.render`, and the example of its docstring."""

import numpy as np
import pytest
from avatar.conftest import splats_of
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("numba")

from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.camera import Camera, look_at
from stga_addon.render.render import render


def one_splat(color):
    """A nearly opaque ball of 2 cm at the world's origin."""
    sh = (np.array(color) - 0.5) / SH_C0
    return splats_of(np.zeros((1, 3)), log_scale=np.log(0.02), opacity=6, sh=sh)


def test_look_at_gives_the_pose_worked_out_by_hand():
    """Catches mirrored axes: from (3, 2, 0) to (1, 2, 0), +y up, right is -z; and wrong colors."""
    camera = look_at((3, 2, 0), (1, 2, 0), width=40, height=30, focal_length=50)
    pose = [[0, 0, -1, 0], [0, -1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    assert_allclose(camera.world_to_camera, pose, atol=1e-15)
    assert_allclose(camera.position, [3, 2, 0], atol=1e-15)
    assert vars(camera) | {"world_to_camera": None} == vars(Camera(40, 30, 50, 50, 20, 15, None))
    with pytest.raises(ValueError, match="parallel to up"):
        look_at((0, 1, 0), (0, 0, 0), 40, 30, 50)
    image = render(one_splat((3.0, 0.5, 0.5)), look_at((0, 0, 1), (0, 0, 0), 64, 48, 400))
    assert_array_equal(image[:, 0, 0], 1)
    assert image.shape == (3, 48, 64)
    assert image.dtype == np.float32
    assert image.max() == 1
