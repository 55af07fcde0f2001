"""Adam with true freezing against torch's, which counts per tensor: here one a row."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.embedding import WORLD
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.rasterize import frames_in_camera, render_backward, render_forward
from stga_addon.training.optimize import adam
from stga_addon.training.optimize.state import new_state
from stga_addon.training.settings import TrainingSettings

from .toys import bits, random_splats, random_state

RATES = {"xyz": 1e-3, "rotation": 5e-3, "log_scale": 2e-2, "opacity": 5e-2}
COLOR_RATES = {"sh": 1e-2, "sh_rest": 1e-3}
OPTIONS = adam.PLAIN._replace(
    beta2=np.float32(0.99), ema_share=np.float32(0.2), epsilon=np.float32(1e-5)
)


def set_gradients(state, rng, scale=1.0):
    for array in state.gradients:
        array[:] = rng.normal(0, scale, array.shape)


def separate_rows(state):
    """Each row's parameters but `sh` as float64 tensors of their own."""
    return [
        {
            name: torch.tensor(
                getattr(state.parameters, name)[n], dtype=torch.float64
            ).requires_grad_()
            for name in RATES
        }
        for n in range(len(state))
    ]


@pytest.mark.parametrize("seed", range(3))
def test_each_row_is_torchs_adam_with_its_own_history(seed):
    """Catches a shared step count, momentum that moves unlisted rows, a swapped rate or beta, a
    misplaced ε, and a running average that begins with the initial value, or goes on while its row
    is frozen.
    """
    state = new_state(random_splats(6, 4, seed))
    rng = np.random.default_rng(seed)
    rows = separate_rows(state)
    groups = [{"params": [row[name] for row in rows], "lr": rate} for name, rate in RATES.items()]
    theirs = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-5)
    history = [[] for _ in rows]
    for _ in range(25):
        listed = np.flatnonzero(rng.random(6) < [1, 0.7, 0.5, 0.3, 0.1, 0.0]).astype(np.int32)
        # Sizes over many orders of magnitude: those of real gradients are 1e-8 to 1e-3.
        set_gradients(state, rng, 10 ** rng.uniform(-8, 0))
        for n, row in enumerate(rows):
            for name, value in row.items():
                gradient = torch.tensor(getattr(state.gradients, name)[n], dtype=torch.float64)
                value.grad = gradient if n in listed else None
        theirs.step()
        adam.step(state, listed, RATES, OPTIONS)
        for n in listed:
            history[n].append(rows[n]["xyz"].detach().clone())
    for n, values in enumerate(history):
        average = torch.tensor(state.parameters.xyz[n], dtype=torch.float64)
        for count, value in enumerate(values, 1):
            average = average.lerp(value, max(0.2, 4 / (count + 3)))
        assert_allclose(state.average.xyz[n], average, rtol=1e-5, atol=25 * RATES["xyz"] * 1e-5)
    for n, row in enumerate(rows):
        for name in RATES:
            # 25 float32 steps of at most the rate each
            found = getattr(state.parameters, name)[n]
            wanted = row[name].detach()
            assert_allclose(found, wanted, rtol=1e-5, atol=25 * RATES[name] * 1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_broken_gradient_leaves_its_row(bad):
    """Catches one NaN spreading into parameters or moments, where it would stay for ever."""
    state = random_state(4, 3)
    before = bits(state)
    state.gradients.log_scale[1, 2] = bad
    adam.step(state, np.arange(4, dtype=np.int32), RATES)
    after = bits(state)
    for part in ("parameters", "first", "second"):
        assert_array_equal(after[f"{part}/log_scale"][1], before[f"{part}/log_scale"][1])
        for row in (0, 2, 3):
            assert (after[f"{part}/log_scale"][row] != before[f"{part}/log_scale"][row]).any()
    for array in (*state.parameters, *state.first, *state.second):
        assert np.isfinite(array).all()


@pytest.mark.parametrize("ahead", [0.0, 0.1])
def test_many_rows(ahead):
    """Catches others' step counts in blocks for threads, and momentum."""
    state = random_state(1500, 7)
    rng = np.random.default_rng(0)
    state.steps[:] = rng.integers(0, 50, 1500)
    rows = np.sort(rng.permutation(1500)[:1100]).astype(np.int32)
    counts = state.steps[rows] + 1.0
    old = {
        f"{p}/{n}": getattr(getattr(state, p), n)[rows].astype(float)
        for p in ("first", "second")
        for n in RATES
    }
    before = {name: getattr(state.parameters, name)[rows].astype(float) for name in RATES}
    adam.step(state, rows, RATES, adam.PLAIN._replace(ahead=np.float32(ahead)))
    assert_array_equal(state.steps[rows], counts)
    for name, value in before.items():
        gradient = getattr(state.gradients, name)[rows].astype(float)
        per_row = counts.reshape(-1, *[1] * (value.ndim - 1))
        first = 0.9 * old[f"first/{name}"] + 0.1 * gradient
        assert_allclose(getattr(state.first, name)[rows], first, rtol=1e-5, atol=1e-6)
        mean = ((1 - ahead) * first + ahead * gradient) / (1 - (1 - ahead) * 0.9**per_row)
        square = (0.999 * old[f"second/{name}"] + 0.001 * gradient**2) / (1 - 0.999**per_row)
        step = RATES[name] * mean / np.sqrt(square)
        # Where the random second moment is near zero a step is many rates long, and rounded in
        # proportion.
        error = np.abs(getattr(state.parameters, name)[rows] - (value - step))
        assert (error <= 1e-6 + 1e-5 * np.abs(step) + 1e-6 * np.abs(value)).all(), name


@pytest.mark.parametrize(("degree", "ahead", "bad"), [(0, 0.1, np.nan), (2, 0, 1e30), (3, 0.1, 0)])
def test_colors_step_by_their_gradients(degree, ahead, bad):
    """Catches colors that are stepped by another row's gradient, count or correction, twice, out of
    focus, beyond the degree in use or at another rate, and a broken gradient that spreads.

    The gradients are those that the same kernel writes where it steps nothing.
    """
    state = random_state(700, 3, degree=3)
    rng = np.random.default_rng(0)
    state.steps[:] = rng.integers(0, 50, 700)
    state.parameters.log_scale[:] += 1.5
    camera = Camera(90, 70, 1000.0, 1000.0, 45.0, 35.0, np.eye(4))
    camera.world_to_camera[2, 3] = 1
    frames = frames_in_camera(WORLD, camera)
    face = np.zeros(700, np.int32)
    focus = rng.random(700) < 0.8
    output = render_forward(state.parameters, face, frames, degree, focus=focus, reach=0)
    v_image = rng.normal(0, 1e-3, output.image.shape).astype(np.float32)
    v_image[:, 40, 50] += np.float32(bad)
    given = output, state.parameters, face, frames, v_image
    rows, _ = render_backward(*given, state.gradients)
    gradient = state.gradients.sh[rows].astype(float)
    gradient[:, (degree + 1) ** 2 :] = 0
    before = {part: getattr(state, part).sh.copy() for part in ("parameters", "first", "second")}
    counts = state.steps.copy()
    options = OPTIONS._replace(ahead=np.float32(ahead))
    color = adam.color_step(state, COLOR_RATES, options, degree)
    again, _ = render_backward(*given, state.gradients, color=color)
    assert_array_equal(again, rows)
    assert_array_equal(state.steps, counts)  # of all parameters together, by `adam.step`
    is_broken = ~(np.abs(gradient) < 1e18).all((1, 2))
    stepped = rows[~is_broken]
    assert (0 < is_broken.sum() < 200) == (bad != 0)
    assert 400 < len(stepped) < 600
    others = np.setdiff1d(np.arange(700), stepped)
    in_use = slice((degree + 1) ** 2)
    for part, array in before.items():
        now = getattr(state, part).sh
        assert_array_equal(now[others], array[others], err_msg=part)
        assert_array_equal(now[:, in_use.stop :], array[:, in_use.stop :], err_msg=part)
    gradient = gradient[~is_broken, in_use]
    count = counts[stepped, None, None] + 1.0
    first = 0.9 * before["first"][stepped, in_use] + 0.1 * gradient
    second = 0.99 * before["second"][stepped, in_use] + 0.01 * gradient**2
    mean = ((1 - ahead) * first + ahead * gradient) / (1 - (1 - ahead) * 0.9**count)
    rate = np.full((in_use.stop, 1), COLOR_RATES["sh_rest"])
    rate[0] = COLOR_RATES["sh"]
    step = rate * mean / (np.sqrt(second / (1 - 0.99**count)) + 1e-5)
    value = before["parameters"][stepped, in_use] - step
    assert_allclose(state.first.sh[stepped, in_use], first, rtol=1e-5, atol=1e-7)
    assert_allclose(state.second.sh[stepped, in_use], second, rtol=1e-5, atol=1e-7)
    assert_allclose(state.parameters.sh[stepped, in_use], value, rtol=1e-5, atol=1e-5)


def test_epsilon_is_the_same_share_at_every_image_size():
    """Catches splats that hardly show learning at another speed on images of another size."""
    camera = Camera(200, 100, 300.0, 300.0, 100.0, 50.0, np.eye(4))
    epsilon = adam.adam_options(TrainingSettings(adam_epsilon=0.003), camera).epsilon
    assert epsilon == np.float32(0.003 / 60_000)
