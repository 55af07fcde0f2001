"""Meshes and views as training reads them: frames of few timesteps kept, no mesh on its thread."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from capture import factory

from stga_addon.avatar.embedding import face_frames
from stga_addon.capture.image_colors import MAX_LATER_TIMESTEPS
from stga_addon.capture.loader import ViewLoader
from stga_addon.capture.model import evenly_spread
from stga_addon.capture.open import open_capture
from stga_addon.training.evaluate.metrics import Residuals
from stga_addon.training.optimize import frames
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.optimize.surface import Surface
from stga_addon.training.optimize.surface_prior import SurfacePrior
from stga_addon.training.optimize.unseen_sides import UnseenSides
from stga_addon.training.run import session
from stga_addon.training.run.session import train_run

from .test_run import make_run
from .toys import assert_same_state

KEPT = 12


@pytest.fixture(autouse=True)
def few_timesteps_are_kept(toy, monkeypatch):
    size = frames.BYTES_PER_TRIANGLE * len(toy.faces)
    monkeypatch.setattr(frames, "CACHE_BYTES", (KEPT + 0.5) * size)


def no_residuals(*arguments):
    return Residuals(np.zeros(1), np.ones(1))


def test_no_mesh_is_read_on_the_training_thread(tmp_path, monkeypatch):
    """Catches training that waits for mesh files, and numbers that depend on it."""
    timesteps = range(2 * KEPT)
    opened = open_capture(factory.write_mesh_capture(tmp_path / "capture", timesteps, range(2)))
    read = []

    def mesh(timestep):
        read.append((timestep, threading.current_thread() is threading.main_thread()))
        return opened.mesh(timestep)

    capture = replace(opened, mesh=mesh, views={"train": opened.views["train"]})
    run = make_run(capture, "global", iterations=len(timesteps) - 1)
    # which read meshes once, before training and after it
    count = len(opened.faces)
    none = np.zeros(count, bool)
    color = np.zeros((count, 3))
    sides = UnseenSides(none, ~none, color, none, color[:, 0], color)
    monkeypatch.setattr(Surface, "_observed", (np.ones(count), ~none))
    monkeypatch.setattr(Surface, "sticks_out", none)
    monkeypatch.setattr(frames, "unseen_sides", lambda _: sides)
    for name in ("prepare", "apply"):
        monkeypatch.setattr(SurfacePrior, name, lambda *_: None)
    monkeypatch.setattr(session, "triangle_residuals", no_residuals)
    train_run(capture, tmp_path / "loaded", run)
    assert {timestep for timestep, _ in read} == set(timesteps[:-1])  # the last one is a test view
    # Before training, splats are placed on the first mesh, and given colors there and on a few
    # later ones.
    before = [timesteps[0], *evenly_spread(timesteps[1:-1], MAX_LATER_TIMESTEPS)]
    assert [timestep for timestep, on_training_thread in read if on_training_thread] == before

    def without_meshes(*arguments, **options):
        return ViewLoader(*arguments, **{**options, "mesh": None})

    read.clear()
    monkeypatch.setattr(session, "ViewLoader", without_meshes)
    train_run(capture, tmp_path / "unloaded", run)
    assert len(read) == len(timesteps) - 1 + len(before)
    assert all(on_training_thread for _, on_training_thread in read)
    assert_same_state(tmp_path / "loaded", tmp_path / "unloaded")


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_frames_are_those_of_the_timesteps_mesh(toy, convention):
    """Catches frames of another timestep or convention, or scaled by the posed mesh."""
    store = FrameStore(toy, convention)
    for timestep in (3, 0, 3):
        expected = face_frames(toy.mesh(timestep), toy.faces, toy.neutral, convention)
        np.testing.assert_equal(vars(store.of(timestep)), vars(expected))
    assert np.abs(store.of(3).origin - store.of(0).origin).max() > 1e-3


def test_meshes_are_read_once_and_few_are_kept(toy):
    """Catches a mesh file read in every iteration, and a long sequence that fills the memory."""
    read = []

    def mesh(timestep):
        read.append(timestep)
        return toy.mesh(3)

    store = FrameStore(replace(toy, mesh=mesh), "stga")
    for _ in range(3):
        store.of(1)
    assert read == [1]
    for timestep in range(2, KEPT + 2):
        store.of(timestep)
    store.of(1)
    assert read == [1, *range(2, KEPT + 2), 1]
    store.clear()
    store.mesh(1)
    store.of(1)
    assert read[-2:] == [1, 1]  # read again, once for mesh and frames
