"""Pruning of floaters, and the sums of blend weights that tell it."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from stga_addon.avatar.splats import SH_C0
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.rasterize import (
    BufferPool,
    blend_weights,
    frames_in_camera,
    render_forward,
)
from stga_addon.training.optimize.floaters import PRUNING_TIMES, FloaterPruning
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.optimize.step_hook import Schedule
from stga_addon.training.optimize.trainer import Trainer

from .toys import Rows, quick_settings, random_splats


def test_blend_weights(toy):
    """Catches weights of another splat, of hidden ones, or of other pixels: the weights of one
    are an image in which it alone is red."""
    splats = random_splats(60, len(toy.faces), degree=0)
    splats = replace(splats, xyz=0.02 * splats.xyz, log_scale=np.log(0.05) + 0 * splats.log_scale)
    view = toy.views["train"][0]
    frames = frames_in_camera(FrameStore(toy, "stga").of(view.timestep), view.camera)

    def rendered(red):
        sh = np.full((len(splats), 1, 3), -0.5 / SH_C0, np.float32)
        sh[red] = 0.5 / SH_C0
        arrays = Parameters(splats.xyz, splats.rotation, splats.log_scale, splats.opacity, sh)
        return render_forward(arrays, splats.face, frames, 0)

    weights = blend_weights(rendered([]), BufferPool())
    assert (weights > 1).sum() > 20
    for row in np.argsort(weights)[::7]:
        assert weights[row] == pytest.approx(rendered([row]).image[0].sum(), rel=1e-4, abs=1e-4)


def test_what_fills_no_view_floats(toy):
    """Catches floaters that stay, bound splats or those outside the trained region that go, and a
    look at every step."""
    trainer = Trainer(toy, quick_settings("global", lattice=1), {})
    state = trainer.state
    state.unbound[:] = np.arange(len(state)) % 3 > 0
    tiny = np.arange(len(state)) % 3 == 1
    state.parameters.log_scale[tiny] = np.log(1e-5)
    state.parameters.opacity[tiny] = -3.0
    state.gradient_count[:] = np.arange(len(state))
    near = state.face < 40

    class Backend(Rows):
        looks = 0

        def blend_weights(self, view):
            self.looks += 1
            return trainer._backend.blend_weights(view)

    for before, now, region, gone in (
        (0.1, PRUNING_TIMES[0] - 0.01, None, None),
        (PRUNING_TIMES[0] - 0.01, PRUNING_TIMES[0], None, tiny),
        (0.7, 0.9, np.arange(len(toy.faces)) < 40, tiny & near),
        (PRUNING_TIMES[1], 0.9, None, None),
    ):
        backend = Backend(state)
        schedule = Schedule(round(1000 * now), now, len(state), region, before)
        FloaterPruning(toy).apply(backend, schedule)
        kept = np.isin(np.arange(len(state)), backend.state.gradient_count)
        assert bool(backend.looks) == (gone is not None)
        if gone is None:
            assert kept.all()
            continue
        assert not kept[gone].any()
        assert kept[~state.unbound].all()
        assert kept[~near].all() == (region is not None)
        assert kept[state.unbound & ~tiny].mean() > 0.3  # others are hidden in all views


@pytest.mark.parametrize("typical", [1.0, 10.0])
def test_after_a_short_training(typical, toy):
    """Catches floaters that have not faded yet, beside fuller hair, and hair that has faded."""
    state = Trainer(toy, quick_settings("global", lattice=0), {}).state
    state.unbound[:] = True
    state.gradient_count[:] = np.arange(len(state))
    weight = np.full(len(state), typical, np.float32)
    weight[::5] = 0.6
    backend = Rows(state)
    backend.blend_weights = lambda view: weight
    FloaterPruning(toy).apply(backend, Schedule(200, PRUNING_TIMES[0], len(state)))
    kept = np.isin(np.arange(len(weight)), backend.state.gradient_count)
    assert_array_equal(kept, (weight > 0.6) | (typical < 5))


def test_a_pruning_comes_once(toy):
    """Catches a look that is missed or made twice where steps take different fractions of the
    budget, or where a run is resumed between two steps."""
    shares = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.05, 60))
    shares = shares[shares < 1]
    begun = Trainer(toy, quick_settings("global", lattice=0), {})
    trainer = copy(begun)
    calls = []
    hooks = {"all": SimpleNamespace(interval=1, apply=lambda _, schedule: calls.append(schedule))}
    trainer.hooks = hooks
    for share in shares:
        trainer.iteration += 1
        trainer._post_step(share)
    assert sum(schedule.passes(0.6) for schedule in calls) == 1
    steps = [n / 50 for n in range(50)]
    for stop in (1, 12, 29, 30, 31, 48):
        calls.clear()
        for part in (steps[:stop], steps[stop:]):
            resumed = copy(begun)
            resumed.iteration = 0 if part[0] == 0 else stop
            resumed.hooks = hooks
            for share in part:
                resumed.iteration += 1
                resumed._post_step(share)
        assert [n for n, schedule in enumerate(calls) if schedule.passes(0.6)] == [30]
