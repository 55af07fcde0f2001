"""Degenerate, flipping and turning triangles, and poses out of range: frames, lattice and what is
rendered of them."""

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import CONVENTIONS, face_frames, to_local, to_world
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.capture.camera import Camera
from stga_addon.flame.quaternions import from_matrices

from .meshes import DEGENERATE, WHOLE, mesh_of
from .scenes import (
    NAMES,
    Scene,
    assert_agree,
    kernel_gradients,
    random_cotangents,
    reference_gradients,
)

FACES = np.array([[0, 1, 2]])


def assert_proper(rotation):
    assert_allclose(
        rotation.transpose(0, 2, 1) @ rotation,
        np.tile(np.eye(3), (len(rotation), 1, 1)),
        atol=1e-12,
    )
    assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize(("collapses", "largest"), [("posed", 0.02), ("neutral", 0.04)])
def test_a_triangle_that_collapses_keeps_its_splats(collapses, largest, convention, name, dtype):
    """Catches an improper rotation, splats that leave the triangle, an inverse that divides by a
    zero scale, and, of a line in the neutral mesh, a ratio of areas whose denominator is rounding:
    three corners on a line, in float32 as in a file, have 1e-13 m², and when the triangle opens its
    splats would be rendered 20,000 times too large, a hundred meters away."""
    meshes = {"posed": WHOLE, "neutral": WHOLE}
    meshes[collapses] = DEGENERATE[name].astype(dtype).astype(float)
    splats = lattice_splats(meshes["neutral"], FACES, convention=convention)
    frames = face_frames(meshes["posed"], FACES, meshes["neutral"], convention)
    assert_proper(frames.rotation)
    world = to_world(splats, frames)
    assert norm(world.xyz - frames.origin, axis=1).max() < largest
    assert np.exp(world.log_scale).max() < 0.02
    back = to_local(world, frames, splats.face)
    for field in ("xyz", "rotation", "log_scale"):
        assert np.isfinite(getattr(world, field)).all(), field
        assert np.isfinite(getattr(back, field)).all(), field


@pytest.mark.parametrize("name", [name for name in DEGENERATE if name != "point"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_rounding_does_not_turn_a_line(convention, name):
    """Catches a normal made of rounding: the same line, rounded in 20 other ways, must keep its
    rotation.

    Without the threshold the frame of a closed eyelid turns at random from one frame to the next.
    """
    posed = DEGENERATE[name]
    noise = default_rng(0).uniform(-2e-9, 2e-9, (20, 3, 3))
    triangles = [posed, *(posed + noise)]
    vertices = np.concatenate(triangles)
    faces = np.arange(63).reshape(-1, 3)
    frames = face_frames(vertices, faces, np.tile(WHOLE, (21, 1)), convention)
    assert_allclose(frames.rotation[1:], np.broadcast_to(frames.rotation[0], (20, 3, 3)), atol=2e-5)


def test_collapsed_triangles_render_and_train_in_float32():
    """Catches NaN from scales of e^−60 and smaller, and gradients that differ from the float64
    reference's."""
    flat = list(DEGENERATE.values())
    posed, faces = mesh_of([*flat, *(WHOLE + 0.02 * n for n in range(len(flat)))])
    neutral, _ = mesh_of([WHOLE] * len(flat) + flat)
    for convention in CONVENTIONS:
        splats = lattice_splats(neutral, faces, 1, 1, opacity_logit=1.0, convention=convention)
        rng = default_rng(1)
        values = {name: getattr(splats, name) for name in NAMES}
        values["rotation"] = rng.normal(size=values["rotation"].shape).astype(np.float32)
        values["sh"] = rng.normal(0, 0.5, values["sh"].shape).astype(np.float32)
        frames = face_frames(posed, faces, neutral, convention)
        pose = np.eye(4)
        pose[:3, 3] = [-0.09, -0.09, 0.5]
        scene = Scene(values, Camera(40, 40, 80.0, 80.0, 20.0, 20.0, pose), 1)
        cotangents = random_cotangents(scene.camera)
        found = kernel_gradients(scene, cotangents, frames, splats.face)
        frames.scale[:] = np.maximum(frames.scale, 1e-30)  # the reference wants its logarithm
        assert_agree(found, reference_gradients(scene, cotangents, frames, splats.face))


def test_quaternions_near_half_turns_from_float32_matrices():
    """Catches a negative square root, or 0/0, where rounding leaves the trace below −1."""
    rng = default_rng(2)
    axes = rng.normal(size=(500, 3))
    axes[:30] = np.repeat(np.eye(3), 10, axis=0)
    axes /= norm(axes, axis=1, keepdims=True)
    angles = np.pi + rng.normal(size=500) * 10.0 ** rng.uniform(-9, -3, 500)
    matrices = Rotation.from_rotvec(axes * angles[:, None]).as_matrix().astype(np.float32)
    assert (np.trace(matrices, axis1=1, axis2=2) < -1).any()
    quaternions = from_matrices(matrices)
    expected = Rotation.from_matrix(matrices.astype(float))
    error = (Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]) * expected.inv()).magnitude()
    assert error.max() < 1e-6
