"""Face frames by timestep, without a memory that grows with the sequence."""

from dataclasses import replace

import numpy as np
import pytest

from stga_addon.avatar.embedding import face_frames
from stga_addon.capture.model import Capture
from stga_addon.training.optimize.frames import CACHED_TIMESTEPS, FrameStore


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_frames_are_those_of_the_timesteps_mesh(toy: Capture, convention: str) -> None:
    """Catches frames of another timestep, of another convention, or scaled by the posed mesh
    instead of the neutral."""
    store = FrameStore(toy, convention)
    for timestep in (3, 0, 3):
        expected = face_frames(toy.mesh(timestep), toy.faces, toy.neutral, convention)
        for name, value in vars(expected).items():
            np.testing.assert_array_equal(getattr(store.of(timestep), name), value)
    assert np.abs(store.of(3).origin - store.of(0).origin).max() > 1e-3


def test_meshes_are_read_once_and_few_are_kept(toy: Capture) -> None:
    """Catches a mesh file read in every iteration, and a long sequence that fills the memory."""
    read: list[int] = []

    def mesh(timestep: int) -> np.ndarray:
        read.append(timestep)
        return toy.mesh(3)

    store = FrameStore(replace(toy, mesh=mesh), "stga")
    for _ in range(3):
        store.of(1)
    assert read == [1]
    for timestep in range(2, CACHED_TIMESTEPS + 2):
        store.of(timestep)
    store.of(1)
    assert read == [1, *range(2, CACHED_TIMESTEPS + 2), 1]
    store.clear()
    store.mesh(1)
    store.of(1)
    assert read[-2:] == [1, 1]  # read again, once for mesh and frames
