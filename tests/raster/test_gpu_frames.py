"""Frames and strain of a posed mesh on a WebGPU device against numpy's."""

import numpy as np
import pytest
from numerics.meshes import bent_ball, collapsed

from raster import gpu_device
from raster.test_kernels import SCENES
from stga_addon.avatar.embedding import CONVENTIONS, face_frames
from stga_addon.avatar.strain import MAX_STRAIN, STRAIN_COMPONENTS, strain_basis
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.rasterize import frames_in_camera
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.frames import Embedding

pytestmark = pytest.mark.needs("adapter")

FRAME_TOLERANCE = 2e-6
"""Of origins in meters and of rotations times scale: float32 at a few meters from the camera."""


@pytest.fixture(scope="module")
def device() -> Device:
    return gpu_device.device()


@pytest.mark.parametrize("mesh", ["ball", "collapsed", "lines in the neutral mesh", "far away"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_frames_and_strain_are_numpys(device: Device, convention: str, mesh: str) -> None:
    """Catches another rule for a triangle without area, an axis that differs, and edges that lose
    digits in float32."""
    posed, neutral, faces = bent_ball() if mesh in ("ball", "far away") else collapsed()
    camera = SCENES["plain"].camera
    camera = Camera(camera.width, camera.height, 50, 50, 25, 20, camera.world_to_camera.copy())
    if mesh == "lines in the neutral mesh":
        posed, neutral = neutral, posed
    if mesh == "far away":
        shift = np.array([1e4, -1e4, 1e4])
        posed, camera.world_to_camera[:3, 3] = (
            posed + shift,
            -camera.world_to_camera[:3, :3] @ shift,
        )
    ends = np.random.default_rng(8).uniform(0, 1.5, (2, len(faces), STRAIN_COMPONENTS)) * [
        [[-1]],
        [[1]],
    ]
    basis = strain_basis(
        neutral, faces, np.float32(ends.swapaxes(0, 1)) if mesh == "ball" else None
    )
    expected = frames_in_camera(face_frames(posed, faces, neutral, convention, basis), camera)
    step = Embedding(device, neutral, faces, convention, basis)
    step.upload(posed, camera)
    with device.record() as work:
        table = step.compose(work, {})
    frames = device.read(table, (len(faces), 12 + STRAIN_COMPONENTS))
    np.testing.assert_allclose(frames[:, :3], expected.origin, atol=FRAME_TOLERANCE)
    # The area of what is a line in float32, whose root is the scale, has hardly any digits.
    tolerance = 1e-5 if mesh == "collapsed" else FRAME_TOLERANCE
    np.testing.assert_allclose(frames[:, 3:12].reshape(-1, 3, 3), expected.matrix, atol=tolerance)
    assert expected.strain.any()
    if mesh == "lines in the neutral mesh":
        # A strain per area that is hardly there; float64 has few digits of it, too.
        assert (np.abs(frames[:, 12:]) <= MAX_STRAIN).all()
    else:
        np.testing.assert_allclose(frames[:, 12:], expected.strain, atol=5e-6)
