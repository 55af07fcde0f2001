"""Adam with true freezing against its formula in float64."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.embedding import WORLD
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.rasterize import frames_in_camera, render_backward, render_forward
from stga_addon.training.optimize import adam
from stga_addon.training.settings import TrainingSettings

from .toys import adam_step, random_state

RATES = {"xyz": 1e-3, "rotation": 5e-3, "log_scale": 2e-2, "opacity": 5e-2}
COLOR_RATES = {"sh": 1e-2, "sh_rest": 1e-3}
OPTIONS = adam.PLAIN._replace(
    beta2=np.float32(0.99), ema_share=np.float32(0.2), epsilon=np.float32(1e-5)
)


@pytest.mark.parametrize("ahead", [0.0, 0.1])
def test_each_row_has_its_own_history(ahead):
    """Catches a shared step count, momentum that moves unlisted rows, a swapped rate or beta, a
    misplaced ε, a running average that begins with the initial value, or goes on while its row is
    frozen, others' counts in blocks for threads, and a NaN that spreads, where it would stay for
    ever."""
    count = 1500
    state = random_state(count, 7)
    rng = np.random.default_rng(0)
    is_new = np.arange(count) < 500
    state.steps[:] = np.where(is_new, 0, rng.integers(0, 50, count))
    for moment in (*state.first, *state.second):
        moment[is_new] = 0
    options = OPTIONS._replace(ahead=np.float32(ahead))
    parts = ("parameters", "first", "second", "average")
    expected = {
        name: [getattr(getattr(state, part), name).astype(float) for part in parts]
        for name in RATES
    }
    steps = state.steps.copy()
    for _ in range(8):
        rows = np.flatnonzero(rng.random(count) < np.linspace(0, 1, count))
        steps[rows] += 1
        # Sizes over many orders of magnitude: those of real gradients are 1e-8 to 1e-3.
        for array in state.gradients:
            array[:] = rng.normal(0, 10 ** rng.uniform(-8, 0), array.shape)
        state.gradients.log_scale[rows[:3], 2] = [np.nan, np.inf, -np.inf]
        adam.step(state, rows.astype(np.int32), RATES, options)
        for name, arrays in expected.items():
            sound = rows[3:] if name == "log_scale" else rows
            gradient = getattr(state.gradients, name)[sound].astype(float)
            own = steps[sound].reshape(-1, *[1] * (gradient.ndim - 1))
            value, *moments, average = (array[sound] for array in arrays)
            stepped = adam_step((value, *moments), gradient, own, RATES[name], options)
            share = np.maximum(options.ema_share, 4 / (own + 3))
            now = (*stepped, average + share * (stepped[0] - average))
            for array, values in zip(arrays, now, strict=True):
                array[sound] = values
    assert_array_equal(state.steps, steps)
    for name, arrays in expected.items():
        for part, array in zip(parts, arrays, strict=True):
            found = getattr(getattr(state, part), name)
            assert_allclose(found, array, rtol=1e-5, atol=1e-6, err_msg=f"{part}/{name}")


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
    rate = np.full((in_use.stop, 1), COLOR_RATES["sh_rest"])
    rate[0] = COLOR_RATES["sh"]
    given = [array[stepped, in_use].astype(float) for array in before.values()]
    value, first, second = adam_step(given, gradient, count, rate, options)
    assert_allclose(state.first.sh[stepped, in_use], first, rtol=1e-5, atol=1e-7)
    assert_allclose(state.second.sh[stepped, in_use], second, rtol=1e-5, atol=1e-7)
    assert_allclose(state.parameters.sh[stepped, in_use], value, rtol=1e-5, atol=1e-5)


def test_epsilon_is_the_same_fraction_at_every_image_size():
    """Catches splats that hardly show learning at another speed on images of another size."""
    camera = Camera(200, 100, 300.0, 300.0, 100.0, 50.0, np.eye(4))
    epsilon = adam.adam_options(TrainingSettings(adam_epsilon=0.003), camera).epsilon
    assert epsilon == np.float32(0.003 / 60_000)
