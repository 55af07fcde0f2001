"""Adam on splats and driven offsets, limits and statistics on a WebGPU device against the CPU's and
against float64."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from raster import gpu_device
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.optimizer import AdamOptions
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import split_rows
from stga_addon.raster.gpu.optimizer import OptimizerTables, optimize, upload_step
from stga_addon.training.optimize.adam import PLAIN

pytestmark = pytest.mark.needs("adapter")

OPTIONS = PLAIN._replace(beta2=np.float32(0.99), ema_share=np.float32(0.05))
RATES = {name: 0.01 * (n + 1) for n, name in enumerate((*Parameters._fields, "sh_rest"))}
COEFFICIENTS, STRAINS = 4, 2
STRIDE = 11 + 3 * COEFFICIENTS + 3 * STRAINS


@pytest.fixture(scope="module")
def device() -> Device:
    return gpu_device.device()


@dataclass
class State:
    """Tables (N, STRIDE) float32, one row a splat, and what belongs to a row."""

    splats: np.ndarray
    gradients: np.ndarray
    first: np.ndarray
    second: np.ndarray
    average: np.ndarray
    steps: np.ndarray
    face: np.ndarray
    unbound: np.ndarray
    share: np.ndarray
    limits: np.ndarray
    screen: np.ndarray
    statistics: np.ndarray
    wanted: np.ndarray

    def copy(self) -> "State":
        return State(**{name: value.copy() for name, value in vars(self).items()})


def random_state(count: int = 700, seed: int = 1) -> State:
    """Rows of any age; a third is not wanted."""
    rng = np.random.default_rng(seed)

    def table() -> np.ndarray:
        return rng.normal(size=(count, STRIDE)).astype(np.float32)

    return State(
        splats=table(), gradients=table(), first=table(), second=table() ** 2, average=table(),
        steps=rng.integers(0, 3000, count).astype(np.int32), face=rng.integers(0, 11,
        count).astype(np.int32),
        unbound=rng.random(count) < 0.3, share=rng.random(count).astype(np.float32),
        limits=rng.uniform(0.2, 2, (3, 11)).astype(np.float32),
        screen=rng.random(count).astype(np.float32),
        statistics=rng.random((count, 2)).astype(np.float32), wanted=rng.random(count) < 0.7,
    )  # fmt: skip


def on_device(
    device: Device, state: State, weights: tuple[float, float, float] = (0, 0, 0),
    statistics: bool = False,
    options: AdamOptions = OPTIONS,
) -> State:  # fmt: skip
    """The state after a step; weights: of scale, distance, opacity."""
    n, upload = len(state.steps), device.upload
    view = device.uniform("View", splats=n, coefficients=COEFFICIENTS, strain_colors=STRAINS)
    history = np.concatenate([state.steps[:, None], state.statistics.view(np.int32)], 1)
    tables = OptimizerTables(
        *(upload(f"test {name}", getattr(state, name)) for name in ("first", "second", "average")),
        history=upload("test history", history), limits=upload("test limits", state.limits.T),
        traits=upload("test traits", np.stack([state.unbound, state.share], 1).astype(np.float32)),
    )  # fmt: skip
    splats = upload("test splats", state.splats)
    gradients = upload("test gradients", state.gradients)
    upload_step(device, RATES, options, weights, statistics)
    with device.record() as work:
        optimize(
            work, n, STRIDE, any(weights[:2]), tables, view=view,
            splats=splats,
            gradients=gradients, face=upload("test face", state.face),
            wanted=upload("test wanted", state.wanted.astype(np.uint32)),
            screen=upload("test screen", state.screen),
        )  # fmt: skip
    after = device.read(tables.history, (n, 3), np.int32)
    read = {
        "splats": splats,
        "gradients": gradients,
        **{k: getattr(tables, k) for k in ("first", "second", "average")},
    }
    return replace(
        state, **{name: device.read(buffer, (n, STRIDE)) for name, buffer in read.items()},
        steps=after[:, 0].copy(),
        statistics=after[:, 1:].copy().view(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e18, -1e20])
def test_a_broken_gradient_leaves_its_field(device: Device, value: float) -> None:
    """Catches NaN, or a square beyond float32, that gets into a row; and other fields that stop
    with it."""
    state = random_state(40)
    state.wanted[:] = True
    expected = split_rows(on_device(device, state).splats, COEFFICIENTS)
    columns = {"xyz": 1, "rotation": 6, "log_scale": 8, "opacity": 10, "sh": 20}
    columns["strain_color"] = STRIDE - 1
    for row, column in enumerate(columns.values()):
        state.gradients[row, column] = value
    got, before = (
        split_rows(each.splats, COEFFICIENTS) for each in (on_device(device, state), state)
    )
    for row, field in enumerate(columns):
        want = getattr(expected, field)
        want[row] = getattr(before, field)[row]
        np.testing.assert_array_equal(getattr(got, field), want, err_msg=field)


@pytest.mark.parametrize("ahead", [0.0, 0.1])
@pytest.mark.parametrize("steps", [0, 1, 2, 10, 100, 499, 500, 10_000, 2**31 - 2])
def test_a_step_at_any_age(device: Device, steps: int, ahead: float) -> None:
    """Catches 1 − βⁿ computed as a difference of nearly equal numbers, and Nesterov's momentum that
    gets into the moments; compared with float64."""
    state = random_state(64)
    state.wanted[:], state.steps[:] = True, steps
    options = OPTIONS._replace(ahead=np.float32(ahead), ema_share=np.float32(0))
    got = on_device(device, state, options=options)
    n, beta1, beta2 = steps + 1.0, float(OPTIONS.beta1), float(OPTIONS.beta2)
    first = beta1 * state.first.astype(float) + (1 - beta1) * state.gradients
    second = beta2 * state.second.astype(float) + (1 - beta2) * state.gradients.astype(float) ** 2
    correct = 1 / (1 - (1 - ahead) * beta1**n), 1 / np.sqrt(-np.expm1(n * np.log(beta2)))
    step = state.splats.astype(float) - got.splats
    np.testing.assert_allclose(got.first, first, rtol=1e-5, atol=1e-6)
    along = first + ahead * (state.gradients - first)
    expected = along * correct[0] / (np.sqrt(second) * correct[1])
    rate = RATES["rotation"]
    np.testing.assert_allclose(step[:, 3:7], rate * expected[:, 3:7], rtol=2e-5, atol=1e-6)
    share = 4 / (n + 3)
    moved = state.average + share * (got.splats - state.average.astype(float))
    np.testing.assert_allclose(got.average, moved, atol=1e-6)


@pytest.mark.parametrize("log_scale", [10.0, 40.0, 43.0])
def test_limit_of_one_enormous_splat(device: Device, log_scale: float) -> None:
    """Catches a square that overflows, and with it everybody's gradient; compared with float64."""
    state = random_state()
    state.splats[5, 7:10], state.wanted[5] = log_scale, True
    state.gradients[:] = 0
    got = on_device(device, state, (0.3, 0, 0)).gradients
    scale = np.exp(state.splats[:, 7:10].astype(float))
    limit = state.limits[state.unbound.astype(int), state.face]
    excess = np.maximum(scale - limit[:, None], 0) * state.wanted[:, None]
    want = np.zeros(got.shape)
    want[:, 7:10] = 0.3 * excess / np.linalg.norm(excess) * scale
    for row in (5, slice(None)):
        largest = np.abs(want[row]).max()
        np.testing.assert_allclose(got[row], want[row], rtol=2e-5, atol=1e-6 * min(largest, 1e-3))


@pytest.mark.parametrize("wanted", ["none", "within the limits"])
def test_norms_of_zero(device: Device, wanted: str) -> None:
    """Catches 0/0 where no row exceeds its limit."""
    state = random_state()
    state.gradients[:] = 0
    state.limits[:] = 1e6
    if wanted == "none":
        state.wanted[:] = False
    got = on_device(device, state, (0.3, 0.2, 0))
    np.testing.assert_array_equal(got.gradients, state.gradients)
