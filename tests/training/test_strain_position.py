"""Training of positions that follow strain: gradient, step, run folder."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stga_addon.avatar.embedding import face_frames
from stga_addon.avatar.file import read_avatar
from stga_addon.avatar.splats import Splats
from stga_addon.avatar.strain import nearby_strain
from stga_addon.capture.model import Capture
from stga_addon.errors import StgaError
from stga_addon.files import read_npz, write_npz
from stga_addon.raster.cpu.optimizer import adam_rows
from stga_addon.raster.cpu.rasterize import frames_in_camera
from stga_addon.raster.render import render_avatar
from stga_addon.training.optimize import adam, strain_position
from stga_addon.training.optimize.state import new_strain_position
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.continuation import starting_state
from stga_addon.training.run.folder import CHECKPOINT, Continuation, Run
from stga_addon.training.run.identity import file_digest
from stga_addon.training.run.loop import train

from .toys import quick_settings


def squeezed(toy: Capture) -> Capture:
    """The toy with a mesh that is narrower along other axes in each timestep."""
    scales = {t: 1 - 0.06 * np.random.default_rng(t).random(3) for t in toy.timesteps}
    return replace(toy, mesh=lambda timestep: toy.neutral * scales[timestep])


def make_trainer(capture: Capture, seed: int = 0) -> Trainer:
    settings = quick_settings("global", lattice=1, strain_position=True, random_background=False)
    trainer = Trainer(capture, settings, {})
    position = trainer.state.strain_position
    assert position is not None
    position.value[:] = np.random.default_rng(seed).normal(0, 1e-3, position.value.shape)
    return trainer


def test_the_step_is_adams_on_the_gradient_of_the_loss(toy: Capture) -> None:
    """Catches a gradient of the wrong sign, unit or axes, and one summed over other splats: against differences of the
    loss by each coefficient of a few triangles."""
    capture = squeezed(toy)
    trainer = make_trainer(capture)
    view = capture.views["train"][0]
    target = np.random.default_rng(1).integers(0, 255, (view.camera.height, view.camera.width, 3), np.uint8)
    state = trainer.state
    position = state.strain_position
    assert position is not None
    before = position.value.copy()
    kept = [t.clone() for t in state.parameters]

    def loss(value: np.ndarray) -> float:
        position.value[:] = value
        for tensor, was in zip(state.parameters, kept, strict=True):
            tensor.copy_(was)
        found = trainer.step(view, target, 0.0)
        assert found is not None
        return found

    loss(before)
    stepped, first = position.value.copy(), position.first.copy()
    gradient = first / (1 - float(adam.BETA1))
    assert (position.steps == (position.steps > 0)).all()
    touched = np.flatnonzero(position.steps)
    assert 0 < len(touched) < len(capture.faces)  # those behind have no gradient
    strongest = touched[np.argsort(-np.abs(gradient[touched]).max((1, 2)))[:6]]
    for face in strongest:
        component, axis = np.unravel_index(np.abs(gradient[face]).argmax(), (3, 3))
        step = 2e-3
        ends = []
        for sign in (1, -1):
            changed = before.copy()
            changed[face, component, axis] += sign * step
            ends.append(loss(changed))
        slope = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(gradient[face, component, axis], slope, rtol=0.1)
    rate = strain_position.RATE_SHARE * trainer.settings.rates.xyz
    moved = (stepped - before)[strongest]
    np.testing.assert_allclose(np.abs(moved).max((1, 2)), rate, rtol=0.05)  # Adam's first step is as long as the rate
    assert (np.sign(moved) == -np.sign(gradient[strongest])).all()


def test_the_step_is_that_of_the_splats_optimizer() -> None:
    """Catches another bias correction, average or count than `adam_rows` has, over several steps of some triangles."""
    rng, faces = np.random.default_rng(2), 5
    state = new_strain_position(rng.normal(0, 1, (faces, 3, 3)))
    tables = [a.copy().reshape(faces, 9) for a in (state.value, state.first, state.second, state.average)]
    steps, epsilon = np.zeros(faces, np.int32), np.float32(1e-3)
    for number in range(4):
        face = np.sort(rng.choice([0, 1, 3, 4] if number % 2 else [0, 2, 3], 40)).astype(np.int32)
        gradient, nearby = rng.normal(0, 1, (40, 3)).astype(np.float32), rng.normal(0, 1, (faces, 3)).astype(np.float32)
        if number == 2:
            gradient[face == 3] = np.inf
        strain_position.step(state, face, gradient, nearby, 0.02, 0.1, epsilon)
        summed = np.zeros((faces, 3))
        np.add.at(summed, face, gradient.astype(np.float64))
        outer = (nearby[:, :, None] * summed[:, None, :]).astype(np.float32).reshape(faces, 9)
        rows = np.unique(face).astype(np.int32)
        if number == 2:
            rows = rows[rows != 3]
        value, first, second, average = tables
        adam_rows(
            rows, steps, (value,), (outer,), (first,), (second,), (average,),
            np.full((1, 9), strain_position.RATE_SHARE * 0.02, np.float32), adam.BETA1, adam.BETA2, epsilon,
            np.float32(0.1),
        )  # fmt: skip
    for found, expected in zip((state.value, state.first, state.second, state.average), tables, strict=True):
        np.testing.assert_allclose(found.reshape(faces, 9), expected, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(state.steps, steps)


def test_training_draws_what_the_avatar_draws(toy: Capture, tmp_path: Path) -> None:
    """Catches a trainer that moves other splats than the avatar it writes, or by other coefficients."""
    capture = squeezed(toy)
    settings = quick_settings("global", iterations=30, lattice=1, strain_position=True, rates_xyz=None)
    run = Run(toy.root, None, "vhap", settings)
    avatar = read_avatar(train(capture, tmp_path / "run", run))
    assert avatar.strain_position is not None
    assert np.abs(avatar.strain_position).max() > 0
    assert avatar.strain_range is not None


def test_resumed_training_is_bit_exact(toy: Capture, tmp_path: Path) -> None:
    """Catches moments, averages or step counts that a checkpoint forgets."""
