"""Frames and strain of a posed mesh on a WebGPU device against numpy's."""

import numpy as np
import pytest
from numerics.meshes import bent_ball, collapsed

from raster import gpu_device
from raster.test_kernels import SCENES
from stga_addon.avatar.embedding import CONVENTIONS, face_frames
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.splats import Splats
from stga_addon.avatar.strain import COLOR_RANGE, MAX_STRAIN, STRAIN_COMPONENTS, strain_basis
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.rasterize import frames_in_camera
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.frames import Embedding

pytestmark = pytest.mark.needs("adapter")

FRAME_TOLERANCE = 2e-6
"""Of origins in meters and of rotations times scale: float32 at a few meters from the camera."""

SHAPES = {
    "xyz": (3,),
    "rotation": (4,),
    "log_scale": (3,),
    "opacity": (),
    "sh": (1, 3),
    "strain_color": (0, 3),
}
"""Of a splat of degree 0 whose color does not follow strain."""


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


def test_without_strain_there_is_none(device: Device) -> None:
    """Catches columns of strain where nobody asked for them, and triangles that lie elsewhere
    then."""
    posed, neutral, faces = bent_ball()
    camera = SCENES["plain"].camera
    step = Embedding(device, neutral, faces, "stga")
    step.upload(posed, camera)
    with device.record() as work:
        table = step.compose(work, {})
    expected = frames_in_camera(face_frames(posed, faces, neutral), camera)
    frames = device.read(table, (len(faces), 12))
    np.testing.assert_allclose(frames[:, :3], expected.origin, atol=FRAME_TOLERANCE)
    np.testing.assert_allclose(
        frames[:, 3:].reshape(-1, 3, 3), expected.matrix, atol=FRAME_TOLERANCE
    )


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_frames_moved_by_strain_are_the_avatars(device: Device, convention: str) -> None:
    """Catches strain that is not averaged, or over other triangles (an open border, three triangles
    on one edge), rest that is not subtracted, a shift in other axes or units, and frames that stay
    moved."""
    posed, neutral, faces = bent_ball()
    faces = np.concatenate([faces[10:], [[*faces[40][:2], faces[30][2]]]])
    rng = np.random.default_rng(9)
    range_of_strain = COLOR_RANGE * rng.uniform(0.5, 1, (len(faces), 1, STRAIN_COMPONENTS)).astype(
        np.float32
    )
    unit = face_frames(neutral, faces, neutral, convention).scale.mean()
    coefficients = rng.normal(0, 0.01 / unit, (len(faces), STRAIN_COMPONENTS, 3)).astype(np.float32)
    bare = {name: np.zeros((0, *shape), np.float32) for name, shape in SHAPES.items()}
    splats = Splats(**bare, face=np.zeros(0, np.int32), unbound=np.zeros(0, bool))
    avatar = Avatar(
        splats,
        convention,
        neutral,
        faces,
        strain_range=range_of_strain,
        driven_offsets={"strain_position": coefficients},
    )
    camera = SCENES["plain"].camera
    basis = strain_basis(neutral, faces, range_of_strain)
    still = frames_in_camera(face_frames(posed, faces, neutral, convention, basis), camera)
    expected = frames_in_camera(avatar.frames(posed), camera)
    assert (np.abs(expected.origin - still.origin).max(axis=1) > 100 * FRAME_TOLERANCE).mean() > 0.9
    step = Embedding(device, neutral, faces, convention, basis, ["strain_position"])
    step.upload(posed, camera)
    for moved, want in ((coefficients, expected), (None, still)):
        uploaded = (
            {} if moved is None else {"strain_position": device.upload("test coefficients", moved)}
        )
        with device.record() as work:
            table = step.compose(work, uploaded)
        frames = device.read(table, (len(faces), 12 + STRAIN_COMPONENTS))
        np.testing.assert_allclose(frames[:, :3], want.origin, atol=FRAME_TOLERANCE)
        np.testing.assert_allclose(
            frames[:, 3:12].reshape(-1, 3, 3), want.matrix, atol=FRAME_TOLERANCE
        )
        np.testing.assert_allclose(frames[:, 12:], want.strain, atol=5e-6)
