"""The public functions of `render.render`, and the example of its docstring."""

from dataclasses import replace

import numpy as np
import pytest
from avatar.conftest import splats_of

pytest.importorskip("numba")

from stga_addon.avatar.splats import SH_C0, Splats
from stga_addon.capture.camera import Camera, look_at
from stga_addon.raster.posed_splats import PosedSplats
from stga_addon.render.render import render, render_layers


def one_splat(color: tuple[float, float, float]) -> Splats:
    """A nearly opaque ball of 2 cm at the world's origin."""
    sh = (np.array(color) - 0.5) / SH_C0
    return splats_of(np.zeros((1, 3)), log_scale=np.log(0.02), opacity=6, sh=sh)


def test_look_at_gives_the_pose_worked_out_by_hand():
    """Catches mirrored axes: from (3, 2, 0) to (1, 2, 0), +y up, right is -z; and wrong colors."""
    camera = look_at((3, 2, 0), (1, 2, 0), width=40, height=30, focal_length=50)
    pose = [[0, 0, -1, 0], [0, -1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(camera.world_to_camera, pose, atol=1e-15)
    np.testing.assert_allclose(camera.position, [3, 2, 0], atol=1e-15)
    assert vars(camera) | {"world_to_camera": None} == vars(Camera(40, 30, 50, 50, 20, 15, None))
    with pytest.raises(ValueError, match="parallel to up"):
        look_at((0, 1, 0), (0, 0, 0), 40, 30, 50)
    splats = one_splat((0, 0, 0))
    splats.xyz[0] = [0.1, 0.08, 0]  # seen from +z, +x is to the right
    image = render(splats, look_at((0, 0, 1), (0, 0, 0), 64, 48, 100))
    row, column = np.unravel_index(np.argmin(image.sum(0)), (48, 64))
    assert (row, column) == (pytest.approx(24 - 8, abs=1), pytest.approx(32 + 10, abs=1))
    image = render(one_splat((3.0, 0.5, 0.5)), look_at((0, 0, 1), (0, 0, 0), 64, 48, 400))
    np.testing.assert_array_equal(image[:, 0, 0], 1)
    assert image.shape == (3, 48, 64)
    assert image.dtype == np.float32
    assert image.max() == 1


@pytest.mark.needs("adapter")
def test_a_gpu_renders_the_same_picture() -> None:
    """Catches triangles' colors, frames, background or antialiasing that only the CPU draws."""
    from numerics.meshes import bent_ball
    from raster import gpu_device

    from stga_addon.avatar.embedding import face_frames
    from stga_addon.render.device import Composer

    posed, neutral, faces = bent_ball()
    count = len(faces)
    random = np.random.default_rng(3)
    splats = splats_of(
        random.normal(0, 0.1, (count, 3)),
        rotation=random.normal(size=(count, 4)),
        log_scale=random.normal(-1, 0.5, (count, 3)),
        opacity=random.normal(1, 1, count),
        sh=random.normal(0, 0.4, (count, 4, 3)),
        face=np.arange(count),
    )
    size = float(np.ptp(posed, axis=0).max())
    camera = look_at((0, 0, 2.5 * size), posed.mean(0), width=90, height=70, focal_length=150)
    color = random.normal(0, 0.3, (count, 3)).astype(np.float32)
    frames = replace(face_frames(posed, faces, neutral), color=color)
    expected = render(splats, camera, (0.2, 0.9, 0.4), frames, antialiased=True)
    composer = Composer(f"gpu:{gpu_device.device().name}")
    layers = [PosedSplats(splats, frames, antialiased=True)]
    got = render_layers(layers, camera, (0.2, 0.9, 0.4), composer)
    assert np.abs(got - np.float32([0.2, 0.9, 0.4])[:, None, None]).max() > 0.2
    np.testing.assert_allclose(got, expected, atol=1e-5)
