"""Density control: what is split, what is pruned, and what must stay as it was."""

import numpy as np
import pytest
import torch
from avatar.conftest import splats_of
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.autograd import render_differentiable
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.training.optimize.density import DensityControl
from stga_addon.training.optimize.state import arrays_of, keep_rows, new_state
from stga_addon.training.optimize.step_hook import Schedule

from .toys import Rows, bits, random_state

FACES = 6
COUNT = 40
MIN_OPACITY = 0.02
FAINT_LOGIT = float(np.log(MIN_OPACITY / (1 - MIN_OPACITY)))


def busy_state(listed):
    """Forty splats on six triangles; the listed ones have a screen gradient, in this order."""
    state = random_state(COUNT, FACES)
    state.face[:] = np.arange(COUNT) % FACES
    state.screen_gradient[:] = 0
    state.gradient_count[:] = 2
    for strength, row in enumerate(reversed(listed), 1):
        state.screen_gradient[row] = float(strength)
    return state


def control(state, budget=1000, share=1.0, seed=0):
    rows = Rows(state)
    density = DensityControl(1, (0.0, 1.0), split_share=share, growth=0.0, seed=seed)
    density.apply(rows, Schedule(0, 0.5, initial_count=len(state) + budget))
    return rows.state


def survivors_first(new, state, listed):
    """What a turn made of the state, which is in the order of the triangles: the survivors in their
    own order, then the halves of the listed ones, all on one side before those on the other."""
    assert (np.diff(new.face) >= 0).all()
    survivors = np.setdiff1d(np.arange(len(state)), listed)
    face = state.face[np.concatenate([survivors, listed, listed])]
    return keep_rows(new, np.argsort(np.argsort(face, kind="stable")))


def test_survivors_keep_everything_and_children_what_steadies_them():
    """Catches moments of other rows, children without one, and splits of what many see."""
    listed = [3, 17, 30]
    state = busy_state(listed)
    before = bits(state)
    after = bits(new := survivors_first(control(state), state, listed))
    survivors = np.setdiff1d(np.arange(COUNT), listed)
    assert len(new) == COUNT + 3
    for name, old in before.items():
        if name not in ("screen_gradient", "gradient_count"):
            assert_array_equal(after[name][: COUNT - 3], old[survivors], err_msg=name)
    parents = np.tile(listed, 2)  # in the order of their screen_gradient
    for name, array in arrays_of(new).items():
        if name.startswith("first"):
            assert not array[COUNT - 3 :].any()
        elif name.startswith(("second", "steps")):
            assert_array_equal(after[name][COUNT - 3 :], before[name][parents], err_msg=name)
    for value, average in zip(new.parameters, new.average, strict=True):
        assert_array_equal(value[COUNT - 3 :], average[COUNT - 3 :])
    assert not new.screen_gradient.any()
    assert not new.gradient_count.any()
    assert {len(array) for array in arrays_of(new).values()} == {COUNT + 3}
    state = busy_state([])
    state.screen_gradient[5] = 8.0
    state.gradient_count[5] = 2.0
    state.screen_gradient[6] = 5.0
    state.gradient_count[6] = 1.0
    new = control(state, budget=1)
    left = {tuple(p) for p in new.splats().xyz.tolist()}
    assert tuple(state.parameters.xyz[6].tolist()) not in left
    assert tuple(state.parameters.xyz[5].tolist()) in left


def test_children_stand_on_either_side_along_the_longest_axis():
    """Catches a rotation transposed or forgotten, an offset's wrong unit, a lost triangle."""
    listed = [3, 17, 30, 8]
    state = busy_state(listed)
    parents = state.splats()
    state.unseen_share[:] = np.arange(COUNT) / COUNT
    controlled = survivors_first(control(state), state, listed)
    children = controlled.splats().rows(np.arange(COUNT - 4, COUNT + 4))
    for n, row in enumerate(listed):
        pair = children.rows(np.array([n, n + 4]))
        assert (pair.face == parents.face[row]).all()
        assert (pair.unbound == parents.unbound[row]).all()
        assert_allclose(pair.xyz.mean(0), parents.xyz[row], atol=1e-6)
        longest = int(np.argmax(parents.log_scale[row]))
        axis = Rotation.from_quat(np.roll(parents.rotation[row], -1)).as_matrix()[:, longest]
        offset = (pair.xyz[1] - pair.xyz[0]) / np.linalg.norm(pair.xyz[1] - pair.xyz[0])
        assert abs(offset @ axis) == pytest.approx(1, abs=1e-4)
        reach = np.abs((pair.xyz - parents.xyz[row]) @ axis) / np.exp(
            parents.log_scale[row, longest]
        )
        assert ((reach > 0.2) & (reach < 1.0)).all()
        shrunk = parents.log_scale[row] - pair.log_scale
        assert (shrunk[:, longest] > 0.2).all()
        assert_array_equal(np.delete(shrunk, longest, axis=1), 0)
        assert_array_equal(pair.sh, parents.sh[[row, row]])
        assert (
            controlled.unseen_share[[COUNT - 4 + n, COUNT + n]] == state.unseen_share[row]
        ).all()


@pytest.mark.parametrize("opacity", [0.2, 0.5, 0.9, 0.99])
def test_a_split_covers_about_what_its_parent_did(opacity):
    """Catches halves that leave a hole or darken the picture, for the next steps to repair."""
    splats = splats_of(
        np.zeros((1, 3)),
        rotation=(0.9, 0.1, -0.3, 0.2),
        log_scale=np.log([0.2, 0.1, 0.1]),
        opacity=np.log(opacity / (1 - opacity)),
    )
    pose = np.eye(4)
    pose[2, 3] = 4.0
    camera = Camera(64, 64, 128.0, 128.0, 32.0, 32.0, pose)

    def cover(state):
        return render_differentiable(
            Parameters(*map(torch.from_numpy, state.parameters)), camera, degree=0
        )[1].numpy()

    state = new_state(splats)
    parent = cover(state)
    state.screen_gradient[0] = 1.0
    state.gradient_count[0] = 1.0
    split = control(state, 10)
    assert len(split) == 2
    children = cover(split)
    assert 0.8 < children.sum() / parent.sum() < 1.1
    assert np.abs(children - parent).max() < 0.3
    rows, columns = np.mgrid[:64, :64]
    for axis in (rows, columns):
        centre = [np.average(axis, weights=picture) for picture in (parent, children)]
        assert centre[1] == pytest.approx(centre[0], abs=0.2)
        spread = [
            np.sqrt(np.average((axis - centre[0]) ** 2, weights=picture))
            for picture in (parent, children)
        ]
        assert 0.75 < spread[1] / spread[0] < 1.1


@pytest.mark.parametrize(
    ("budget", "share", "split"), [(0, 1.0, 0), (2, 1.0, 2), (1000, 0.05, 2), (1000, 1.0, 5)]
)
def test_budget_and_fraction_bound_the_growth(budget, share, split):
    """Catches unbounded growth, and splits of others than have the largest screen gradient."""
    listed = [20, 4, 33, 11, 26]
    state = busy_state(listed)
    gone = {tuple(p) for p in state.splats().xyz[listed[:split]].tolist()}
    new = control(state, budget, share)
    assert len(new) == COUNT + split
    left = {tuple(p) for p in new.splats().xyz.tolist()}
    assert not gone & left
    assert {tuple(p) for p in state.splats().xyz[listed[split:]].tolist()} <= left


def test_faint_splats_go_but_no_triangles_last_one():
    """Catches bald triangles, for ever; unbound splats are not a triangle's own."""
    state = busy_state([])
    state.unbound[:] = np.arange(COUNT) % 7 == 3
    state.parameters.opacity[:] = np.where(
        np.arange(COUNT) < 30, FAINT_LOGIT - 0.1, FAINT_LOGIT + 0.1
    )
    state.parameters.opacity[(state.face == 2)] = FAINT_LOGIT - 1
    state.parameters.opacity[14] = FAINT_LOGIT - 0.5  # the most opaque of triangle 2
    state.parameters.opacity[38] = 3.0  # unbound, of triangle 2
    new = control(state)
    bound = new.face[~new.unbound]
    assert set(bound.tolist()) == set(range(FACES))
    assert int((bound == 2).sum()) == 1
    assert new.parameters.opacity[(new.face == 2) & ~new.unbound].tolist() == pytest.approx(
        [FAINT_LOGIT - 0.5]
    )
    others = new.face != 2
    assert (new.parameters.opacity[others] > FAINT_LOGIT).all()
    assert (new.parameters.opacity[new.unbound & others] > FAINT_LOGIT).all()
    assert int(others.sum()) == sum(n >= 30 and n % FACES != 2 for n in range(COUNT))
