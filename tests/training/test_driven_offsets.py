"""Training of driven offsets: gradient, step, run folder."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.file import Avatar
from stga_addon.avatar.offsets import COLOR, OFFSETS, POSITION, SCALE, SIGNALS
from stga_addon.capture.images import read_view
from stga_addon.render.render import render_avatar
from stga_addon.training.optimize import adam
from stga_addon.training.optimize.backend import RenderOptions
from stga_addon.training.optimize.cpu_backend import CpuBackend
from stga_addon.training.optimize.state import new_offset
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.run.checkpoint import trained_strain_range

from .toys import adam_step, quick_settings, random_state


def squeezed(toy):
    """The toy with a mesh that is narrower along other axes in each timestep."""
    scales = {t: 1 - 0.06 * default_rng(t).random(3) for t in toy.timesteps}
    return replace(toy, mesh=lambda timestep: toy.neutral * scales[timestep])


SIZES = {POSITION: 1e-3, SCALE: 0.1, COLOR: 0.1}
"""Of coefficients."""


def make_trainer(capture, *offsets, seed=0):
    settings = quick_settings(
        "global", lattice=1, driven_offsets=offsets or tuple(OFFSETS), random_background=False
    )
    trainer = Trainer(capture, settings, {})
    rng = default_rng(seed)
    for name, state in trainer.state.driven_offsets.items():
        state.value[:] = rng.normal(0, SIZES[OFFSETS[name].target], state.value.shape)
    return trainer


@pytest.mark.parametrize("name", OFFSETS)
def test_the_gradient_is_that_of_the_loss(toy, name):
    """Catches a gradient of the wrong sign, unit or axes, and one summed over other splats: against
    differences of the loss by each coefficient of a few triangles."""
    capture = squeezed(toy)
    trainer = make_trainer(capture, name)
    offset = OFFSETS[name]
    view = capture.views["train"][0]
    target = default_rng(1).integers(0, 255, (view.camera.height, view.camera.width, 3), np.uint8)
    state = trainer.state
    position = state.driven_offsets[name]
    before = position.value.copy()
    kept = [array.copy() for array in state.parameters]

    def loss(value):
        position.value[:] = value
        for array, was in zip(state.parameters, kept, strict=True):
            array[:] = was
        return trainer.step(view, target, 0.0)

    loss(before)
    gradient = position.first / (1 - float(adam.PLAIN.beta1))
    assert position.steps.max() == 1
    touched = np.flatnonzero(position.steps)
    assert len(touched)
    strongest = touched[np.argsort(-np.abs(gradient[touched]).max((1, 2)))[:6]]
    for face in strongest:
        component, axis = np.unravel_index(np.abs(gradient[face]).argmax(), (3, 3))
        step = 1e-4 if offset.target == POSITION else 5e-3
        ends = []
        for sign in (1, -1):
            changed = before.copy()
            changed[face, component, axis] += sign * step
            ends.append(loss(changed))
        slope = (ends[0] - ends[1]) / (2 * step)
        assert_allclose(gradient[face, component, axis], slope, rtol=0.1)


def test_the_step_is_adam_in_float64():
    """Catches a bias correction, an average or a count that is not each triangle's own, gradients
    of splats that were not trained, and a broken gradient that gets in."""
    rng = default_rng(2)
    faces = 6
    rate = 0.02
    options = adam.PLAIN._replace(ema_share=np.float32(0.1), epsilon=np.float32(1e-3))
    state = new_offset(rng.normal(0, 1, (faces, 3, 3)))
    offset = OFFSETS["strain_position"]
    value = state.value.astype(np.float64)
    average = state.value.astype(np.float64)
    first = np.zeros_like(value)
    second = np.zeros_like(value)
    steps = np.zeros(faces, int)
    for number in range(8):
        face = rng.choice([0, 1, 3, 4] if number % 2 else [0, 2, 3], 40).astype(np.int32)
        rows = rng.permutation(40).astype(np.int32)[:25]
        gradient = rng.normal(0, 1, (40, 3)).astype(np.float32)
        smoothed = rng.normal(0, 1, (faces, 3)).astype(np.float32)
        if number == 2:
            gradient[rows[face[rows] == 3]] = np.inf
        splats = random_state(40, faces)
        splats = replace(splats, face=face, driven_offsets={offset.name: state})
        splats.gradients.xyz[:] = gradient
        signal = {offset: smoothed}.__getitem__
        rates = {offset.rate: rate}
        adam.step_offsets(splats, rows, signal, rates, options)
        for f in np.unique(face[rows]):
            steps[f] += 1
            g = smoothed[f][:, None] * gradient[rows[face[rows] == f]].astype(float).sum(0)
            if np.isfinite(g).all():
                own = (value[f], first[f], second[f])
                own = adam_step(own, g, steps[f], offset.rate_fraction * rate, options)
                value[f], first[f], second[f] = own
                average[f] += max(0.1, 4 / (steps[f] + 3)) * (value[f] - average[f])
    assert_array_equal(state.steps, steps)
    assert steps.min() == 0
    for found, expected in ((state.value, value), (state.first, first), (state.average, average)):
        assert_allclose(found, expected, rtol=2e-4, atol=1e-6)
    assert_allclose(state.second, second, rtol=2e-4)


def test_tracking_follows_splats_that_move_and_grow(toy, monkeypatch):
    """Catches a gradient of the mesh that takes driven splats to be where they are at rest, or as
    large: against differences of the loss, the signal held. It lacks what splats do at the edge
    where they are cut off."""
    held = np.full((len(toy.faces), 3), [0.7, 0.7, 0], np.float32)
    monkeypatch.setitem(SIGNALS, "smoothed_strain", lambda basis, frames: held)
    trainer = make_trainer(squeezed(toy), "strain_position", "strain_scale")
    offsets = trainer.state.driven_offsets
    view = toy.views["train"][0]
    offsets["strain_scale"].value[:] = np.diag([-1, 0, 0])  # half as large
    offsets["strain_position"].value[:, 1] = 0.005 * np.eye(3)[2]  # outwards
    backend = CpuBackend(trainer.settings, trainer.frames, trainer.state)
    target = read_view(view)[1]
    black = np.zeros(3, np.float32)
    mesh = trainer.frames.mesh(view.timestep).copy()

    def loss(posed):
        trainer.frames.clear()
        trainer.frames.mesh(view.timestep, posed)
        return backend.mesh_gradient([(view, target)], [1.0], RenderOptions(black, 0))

    _, gradient = loss(mesh)
    for move in (*np.eye(3)[:, None], mesh - mesh.mean(0)):
        step = 3e-4 / abs(move).max()
        slope = (loss(mesh + step * move)[0] - loss(mesh - step * move)[0]) / (2 * step)
        assert (gradient * move).sum() == pytest.approx(slope, rel=0.15, abs=0.015)


def test_training_draws_what_the_avatar_draws(toy):
    """Catches a trainer whose splats move otherwise than those of the avatar that it writes."""
    capture = squeezed(toy)
    trainer = make_trainer(capture)
    for state in trainer.state.driven_offsets.values():
        state.average[:] = 3 * state.value
    view = capture.views["val"][0]
    seen = trained_strain_range(capture, capture.mesh, None)
    avatar = Avatar(
        trainer.state.splats(averaged=True),
        "stga",
        capture.neutral.astype(np.float32),
        capture.faces,
        strain_range=seen,
        driven_offsets={n: state.average for n, state in trainer.state.driven_offsets.items()},
    )
    drawn = trainer.render(view, 0.0)
    expected = render_avatar(avatar, capture.mesh(view.timestep), view.camera, (1.0, 1.0, 1.0))
    assert_allclose(drawn, expected, atol=2e-5)
    plain = replace(avatar, driven_offsets={})
    still = render_avatar(plain, capture.mesh(view.timestep), view.camera, (1.0, 1.0, 1.0))
    assert np.abs(still - drawn).max() > 0.005
