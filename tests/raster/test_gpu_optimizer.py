"""Adam and limits on a WebGPU device at the edge of float32, against float64."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from raster.gpu_autograd import split_rows
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.gpu.optimizer import OptimizerTables, optimize, upload_step
from stga_addon.training.optimize.adam import PLAIN

pytestmark = pytest.mark.needs("adapter")

OPTIONS = PLAIN._replace(beta2=np.float32(0.99), ema_share=np.float32(0.05))
NAMES = *Parameters._fields, "sh_rest", "strain_color"
RATES = {name: 0.01 * (n + 1) for n, name in enumerate(NAMES)}
COEFFICIENTS = 4
STRIDE = 11 + 3 * COEFFICIENTS
TABLES = ("splats", "gradients", "first", "second", "average")


def random_state(count=700, seed=1):
    """Tables (N, STRIDE) float32, one row a splat, of any age, and what belongs to a row; a third
    is not wanted."""
    rng = np.random.default_rng(seed)
    tables = {name: rng.normal(size=(count, STRIDE)).astype(np.float32) for name in TABLES}
    tables["second"] **= 2
    return SimpleNamespace(
        **tables,
        steps=rng.integers(0, 3000, count).astype(np.int32),
        face=rng.integers(0, 11, count).astype(np.int32),
        unbound=rng.random(count) < 0.3,
        limits=rng.uniform(0.2, 2, (3, 11)).astype(np.float32),
        wanted=rng.random(count) < 0.7,
    )


def on_device(device, state, weights=(0, 0, 0), options=OPTIONS):
    """The tables after a step; weights: of scale, distance, opacity."""
    n = len(state.steps)
    upload = device.upload
    buffers = {name: upload(f"test {name}", getattr(state, name)) for name in TABLES}
    history = np.zeros((n, 3), np.int32)
    traits = np.zeros((n, 2), np.float32)
    history[:, 0] = state.steps
    traits[:, 0] = state.unbound
    tables = OptimizerTables(
        *(buffers[name] for name in TABLES[2:]),
        upload("test history", history),
        upload("test traits", traits),
        upload("test limits", state.limits.T),
    )
    given = {name: buffers[name] for name in TABLES[:2]}
    given["view"] = device.uniform("View", splats=n, coefficients=COEFFICIENTS)
    given |= {"face": upload("test face", state.face), "screen": device.buffer("test screen", n)}
    given["wanted"] = upload("test wanted", state.wanted.astype(np.uint32))
    upload_step(device, RATES, options, weights, statistics=False)
    with device.record() as work:
        optimize(work, n, STRIDE, any(weights[:2]), tables, **given)
    read = {name: device.read(buffer, (n, STRIDE)) for name, buffer in buffers.items()}
    return SimpleNamespace(**read)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e18, -1e20])
def test_a_broken_gradient_leaves_its_field(device, value):
    """Catches NaN, or a square beyond float32, that gets into a row; and other fields that stop
    with it."""
    state = random_state(40)
    state.wanted[:] = True
    expected = split_rows(on_device(device, state).splats, COEFFICIENTS)
    columns = {"xyz": 1, "rotation": 6, "log_scale": 8, "opacity": 10, "sh": 20}
    for row, column in enumerate(columns.values()):
        state.gradients[row, column] = value
    got, before = (
        split_rows(each.splats, COEFFICIENTS) for each in (on_device(device, state), state)
    )
    for row, field in enumerate(columns):
        want = getattr(expected, field)
        want[row] = getattr(before, field)[row]
        assert_array_equal(getattr(got, field), want, err_msg=field)


@pytest.mark.parametrize("ahead", [0.0, 0.1])
@pytest.mark.parametrize("steps", [0, 1, 2, 10, 100, 499, 500, 10_000, 2**31 - 2])
def test_a_step_at_any_age(device, steps, ahead):
    """Catches 1 − βⁿ computed as a difference of nearly equal numbers, and Nesterov's momentum that
    gets into the moments; compared with float64."""
    state = random_state(64)
    state.wanted[:] = True
    state.steps[:] = steps
    options = OPTIONS._replace(ahead=np.float32(ahead), ema_share=np.float32(0))
    got = on_device(device, state, options=options)
    n = steps + 1.0
    beta1 = float(OPTIONS.beta1)
    beta2 = float(OPTIONS.beta2)
    first = beta1 * state.first.astype(float) + (1 - beta1) * state.gradients
    second = beta2 * state.second.astype(float) + (1 - beta2) * state.gradients.astype(float) ** 2
    correct = 1 / (1 - (1 - ahead) * beta1**n), 1 / np.sqrt(-np.expm1(n * np.log(beta2)))
    step = state.splats.astype(float) - got.splats
    assert_allclose(got.first, first, rtol=1e-5, atol=1e-6)
    along = first + ahead * (state.gradients - first)
    expected = along * correct[0] / (np.sqrt(second) * correct[1])
    rate = RATES["rotation"]
    assert_allclose(step[:, 3:7], rate * expected[:, 3:7], rtol=2e-5, atol=1e-6)
    share = 4 / (n + 3)
    moved = state.average + share * (got.splats - state.average.astype(float))
    assert_allclose(got.average, moved, atol=1e-6)


@pytest.mark.parametrize("log_scale", [10.0, 40.0, 43.0])
def test_limit_of_one_enormous_splat(device, log_scale):
    """Catches a square that overflows, and with it everybody's gradient; compared with float64."""
    state = random_state()
    state.splats[5, 7:10] = log_scale
    state.wanted[5] = True
    state.gradients[:] = 0
    got = on_device(device, state, (0.3, 0, 0)).gradients
    scale = np.exp(state.splats[:, 7:10].astype(float))
    limit = state.limits[state.unbound.astype(int), state.face]
    excess = np.maximum(scale - limit[:, None], 0) * state.wanted[:, None]
    want = np.zeros(got.shape)
    want[:, 7:10] = 0.3 * excess / np.linalg.norm(excess) * scale
    for row in (5, slice(None)):
        largest = np.abs(want[row]).max()
        assert_allclose(got[row], want[row], rtol=2e-5, atol=1e-6 * min(largest, 1e-3))


@pytest.mark.parametrize("wanted", ["none", "within the limits"])
def test_norms_of_zero(device, wanted):
    """Catches 0/0 where no row exceeds its limit."""
    state = random_state()
    state.gradients[:] = 0
    state.limits[:] = 1e6
    if wanted == "none":
        state.wanted[:] = False
    got = on_device(device, state, (0.3, 0.2, 0))
    assert_array_equal(got.gradients, state.gradients)
