"""Adam on splats and driven offsets, limits and statistics on a WebGPU device against the CPU's and
against float64."""

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import pytest

from raster import gpu_device
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.optimizer import (
    AdamOptions,
    AdamTables,
    adam_rows,
    distance_limit,
    opacity_weight,
    scale_limit,
)
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import VIEW, splat_rows, split_rows
from stga_addon.raster.gpu.optimizer import (
    OffsetTables,
    OptimizerTables,
    optimize,
    splats_by_triangle,
    step_offsets,
    upload_step,
)
from stga_addon.training.optimize import driven_offsets as cpu_offsets
from stga_addon.training.optimize.adam import BETA1, BETA2, EPSILON
from stga_addon.training.optimize.state import OffsetState

pytestmark = pytest.mark.needs("adapter")

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
        steps=rng.integers(0, 3000, count).astype(np.int32), face=rng.integers(0, 11, count).astype(np.int32),
        unbound=rng.random(count) < 0.3, share=rng.random(count).astype(np.float32),
        limits=rng.uniform(0.2, 2, (3, 11)).astype(np.float32), screen=rng.random(count).astype(np.float32),
        statistics=rng.random((count, 2)).astype(np.float32), wanted=rng.random(count) < 0.7,
    )  # fmt: skip


def on_device(
    device: Device, state: State, weights: tuple[float, float, float] = (0, 0, 0), statistics: bool = False,
    ema_share: float = 0.05, epsilon: float = EPSILON,
) -> State:  # fmt: skip
    """The state after a step; weights: of scale, distance, opacity."""
    n, upload = len(state.steps), device.upload
    view = np.zeros(1, VIEW)
    view["splats"], view["coefficients"], view["strain_colors"] = n, COEFFICIENTS, STRAINS
    history = np.concatenate([state.steps[:, None], state.statistics.view(np.int32)], 1)
    tables = OptimizerTables(
        *(upload(f"test {name}", getattr(state, name)) for name in ("first", "second", "average")),
        history=upload("test history", history), limits=upload("test limits", state.limits.T),
        traits=upload("test traits", np.stack([state.unbound, state.share], 1).astype(np.float32)),
    )  # fmt: skip
    splats, gradients = (
        upload("test splats", state.splats),
        upload("test gradients", state.gradients),
    )
    upload_step(device, RATES, (BETA1, BETA2), epsilon, ema_share, weights, statistics)
    with device.record() as work:
        optimize(
            work, n, STRIDE, any(weights[:2]), tables, view=upload("view", view, "uniform"), splats=splats,
            gradients=gradients, face=upload("test face", state.face),
            wanted=upload("test wanted", state.wanted.astype(np.uint32)), screen=upload("test screen", state.screen),
        )  # fmt: skip
    after = device.read(tables.history, (n, 3), np.int32)
    read = {
        "splats": splats,
        "gradients": gradients,
        **{k: getattr(tables, k) for k in ("first", "second", "average")},
    }
    return replace(
        state, **{name: device.read(buffer, (n, STRIDE)) for name, buffer in read.items()}, steps=after[:, 0].copy(),
        statistics=after[:, 1:].copy().view(np.float32),
    )  # fmt: skip


def on_cpu(
    state: State, weights: tuple[float, float, float] = (0, 0, 0), ema_share: float = 0.05
) -> State:
    """The same by the CPU's kernels."""
    state, rows = state.copy(), np.flatnonzero(state.wanted).astype(np.int32)
    splats, gradients = (
        split_rows(state.splats, COEFFICIENTS),
        split_rows(state.gradients, COEFFICIENTS),
    )
    given = state.face, state.unbound
    if weights[0]:
        scale_limit(
            rows, splats.log_scale, *given, state.limits[:2].copy(), weights[0], gradients.log_scale
        )
    if weights[2]:
        opacity_weight(rows, splats.opacity, state.share, weights[2], gradients.opacity)
    if weights[1]:
        distance_limit(rows, splats.xyz, *given, state.limits[2].copy(), weights[1], gradients.xyz)
    tables = [
        split_rows(table, COEFFICIENTS) for table in (state.first, state.second, state.average)
    ]
    parameters = []
    for name, *parts in zip(Parameters._fields, splats, gradients, *tables, strict=True):
        flat = [part.reshape(len(part), -1) for part in parts]
        rates = np.full(flat[0].shape[1], RATES[name], np.float32)
        if name == "sh":
            rates[3:] = RATES["sh_rest"]
        parameters.append(AdamTables(*flat, rates))
    options = AdamOptions(BETA1, BETA2, EPSILON, np.float32(ema_share))
    adam_rows(rows, state.steps, tuple(parameters), options)
    names = ("splats", "gradients", "first", "second", "average")
    rows_of = {
        name: splat_rows(table)
        for name, table in zip(names, (splats, gradients, *tables), strict=True)
    }
    return replace(state, **rows_of)


TABLES = ("splats", "gradients", "first", "second", "average", "steps")


def assert_same_step(got: State, want: State, before: State) -> None:
    """Up to the CPU's rounding: LLVM expands (1 − β)·g², which loses digits."""
    moved = np.abs(want.splats - before.splats)
    for name in TABLES:
        slack = moved if name in ("splats", "average") else np.abs(getattr(want, name))
        off = np.abs(getattr(got, name) - getattr(want, name)) > 2e-6 + 1e-4 * slack
        assert not off.any(), f"{name}: {np.argwhere(off)[:5].tolist()}"


@pytest.mark.parametrize(
    "weights", [(0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0, 0, 0.5), (0.3, 0.2, 0.5)], ids=str
)
def test_a_step_is_the_cpus(device: Device, weights: tuple[float, float, float]) -> None:
    """Catches a wrong moment, correction, rate or limit, a norm that misses rows, and a row that is
    not its own."""
    state = random_state()
    assert_same_step(on_device(device, state, weights), on_cpu(state, weights), state)


def test_rows_that_are_not_wanted_keep_every_bit(device: Device) -> None:
    """Catches momentum, limits or statistics that reach frozen rows: in every table, NaN's own bits
    too."""
    state = random_state()
    for table in (state.splats, state.gradients, state.first, state.second, state.average):
        table.view(np.uint32)[~state.wanted] = np.random.default_rng(4).integers(
            0, 2**32, STRIDE, np.uint32
        )
    got = on_device(device, state, (0.3, 0.2, 0.5), statistics=True)
    for name in (*TABLES, "statistics"):
        got_bits, bits = (getattr(s, name)[~state.wanted].view(np.uint32) for s in (got, state))
        np.testing.assert_array_equal(got_bits, bits, err_msg=name)
        if name != "gradients":
            assert (getattr(got, name)[state.wanted] != getattr(state, name)[state.wanted]).any(), (
                name
            )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e18, -1e20])
def test_a_broken_gradient_leaves_its_field(device: Device, value: float) -> None:
    """Catches NaN, or a square beyond float32, that gets into a row; and other fields that stop
    with it."""
    state = random_state(40)
    state.wanted[:] = True
    columns = {
        "xyz": 1,
        "rotation": 6,
        "log_scale": 8,
        "opacity": 10,
        "sh": 20,
        "strain_color": STRIDE - 1,
    }
    for row, column in enumerate(columns.values()):
        state.gradients[row, column] = value
    got, want = on_device(device, state), on_cpu(state)
    state.gradients[:], got.gradients[:], want.gradients[:] = 0, 0, 0  # which are broken
    assert_same_step(got, want, state)
    for row, field in enumerate(columns):
        before, after = (
            getattr(split_rows(s.splats, COEFFICIENTS), field)[row] for s in (state, got)
        )
        np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("steps", [0, 1, 2, 10, 100, 499, 500, 10_000, 2**31 - 2])
def test_a_step_at_any_age(device: Device, steps: int) -> None:
    """Catches 1 − βⁿ computed as a difference of nearly equal numbers; compared with float64."""
    state = random_state(64)
    state.wanted[:], state.steps[:] = True, steps
    got = on_device(device, state, ema_share=0.0)
    n, beta1, beta2 = steps + 1.0, float(BETA1), float(BETA2)
    first = beta1 * state.first.astype(float) + (1 - beta1) * state.gradients
    second = beta2 * state.second.astype(float) + (1 - beta2) * state.gradients.astype(float) ** 2
    correct = -1 / np.expm1(n * np.log(beta1)), 1 / np.sqrt(-np.expm1(n * np.log(beta2)))
    step = state.splats.astype(float) - got.splats
    expected = first * correct[0] / (np.sqrt(second) * correct[1])
    rate = RATES["rotation"]
    np.testing.assert_allclose(step[:, 3:7], rate * expected[:, 3:7], rtol=2e-5, atol=1e-6)
    share = 4 / (n + 3)
    moved = state.average + share * (got.splats - state.average.astype(float))
    np.testing.assert_allclose(got.average, moved, atol=1e-6)


@pytest.mark.parametrize("log_scale", [10.0, 40.0, 43.0])
def test_limit_of_one_enormous_splat(device: Device, log_scale: float) -> None:
    """Catches a square that overflows, and with it everybody's gradient."""
    state = random_state()
    state.splats[5, 7:10], state.wanted[5] = log_scale, True
    state.gradients[:] = 0
    got, want = on_device(device, state, (0.3, 0.2, 0)), on_cpu(state, (0.3, 0.2, 0))
    for row in (5, slice(None)):
        largest = np.abs(want.gradients[row]).max()
        np.testing.assert_allclose(
            got.gradients[row], want.gradients[row], rtol=2e-5, atol=1e-6 * min(largest, 1e-3)
        )


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


def test_statistics_are_sums_and_counts(device: Device) -> None:
    """Catches screen gradients of a local iteration, or counts that a row of another splat gets."""
    state = random_state()
    got = on_device(device, state, statistics=True)
    added = np.stack([state.screen, np.ones_like(state.screen)], 1) * state.wanted[:, None]
    np.testing.assert_allclose(got.statistics, state.statistics + added, rtol=1e-6)
    np.testing.assert_array_equal(on_device(device, state).statistics, state.statistics)


def test_the_same_bits_twice(device: Device) -> None:
    """Catches sums in the order of chance."""
    state = random_state(5000)
    once, twice = (on_device(device, state, (0.3, 0.2, 0.5), True) for _ in range(2))
    for name in (*TABLES, "statistics"):
        np.testing.assert_array_equal(getattr(once, name), getattr(twice, name), err_msg=name)


NAME = "strain_position"
TRIANGLES, SPLATS = 300, 900
OFFSET_EPSILON, EMA_SHARE = np.float32(1e-3), 0.02


def random_offset(seed: int = 0) -> OffsetState:
    """Triangles of any age."""
    rng = np.random.default_rng(seed)
    value, first, second, average = rng.normal(size=(4, TRIANGLES, 3, 3)).astype(np.float32)
    return OffsetState(
        value, first, second**2, average, rng.integers(0, 3000, TRIANGLES).astype(np.int32)
    )


def stepped(
    device: Device, state: OffsetState, face: np.ndarray, wanted: np.ndarray, gradients: np.ndarray,
    smoothed: np.ndarray, rate: float,
) -> OffsetState:  # fmt: skip
    """The state after a step on the device."""
    view = np.zeros(1, VIEW)
    view["splats"], view["coefficients"], view["strain_colors"] = SPLATS, 4, 2
    rates = {**RATES, "xyz": rate}
    upload_step(
        device, rates, (BETA1, BETA2), OFFSET_EPSILON, EMA_SHARE, (0, 0, 0), False, TRIANGLES
    )
    named = {
        name: device.upload(f"test position {name}", table) for name, table in vars(state).items()
    }
    tables = OffsetTables(
        *named.values(),
        device.upload("test splats by triangle", splats_by_triangle(face, TRIANGLES)),
    )
    with device.record() as work:
        step_offsets(
            work, TRIANGLES, {NAME: tables}, {NAME: device.upload("test signal", smoothed)},
            view=device.upload("view", view, "uniform"), gradients=device.upload("test gradients", gradients),
            wanted=device.upload("test wanted", wanted.astype(np.uint32)),
        )  # fmt: skip
    arrays = vars(state).items()
    return OffsetState(**{k: device.read(named[k], was.shape, was.dtype) for k, was in arrays})


def test_a_step_of_offsets_is_the_cpus(device: Device) -> None:
    """Catches gradients of splats that were not trained or of other triangles, a wrong age, rate or
    average, a broken gradient that gets in, and a triangle stepped that is not to be: over several
    steps."""
    rng, state = np.random.default_rng(1), random_offset()
    expected = deepcopy(state)
    face = rng.integers(0, TRIANGLES, SPLATS).astype(np.int32)
    face[face == 7] = 8  # one without splats
    for number in range(4):
        gradients = rng.normal(size=(SPLATS, STRIDE)).astype(np.float32)
        smoothed = rng.normal(size=(TRIANGLES, 3)).astype(np.float32)
        wanted = rng.random(SPLATS) < 0.5
        gradients[~wanted] = np.nan  # written in another iteration
        broken = np.flatnonzero(wanted)[:5]
        gradients[broken, 1] = np.float32([np.nan, np.inf, -np.inf, 3e18, 1e30])
        smoothed[face[broken]] = [1, -1, 0.5]
        smoothed[face[broken[1]]] = 0  # times infinity
        before = deepcopy(state)
        state = stepped(device, state, face, wanted, gradients, smoothed, 0.02)
        with np.errstate(invalid="ignore", over="ignore"):
            rows, xyz = np.flatnonzero(wanted).astype(np.int32), gradients[:, :3].copy()
            cpu_offsets.step(
                {NAME: expected},
                rows,
                face,
                xyz,
                lambda _, s=smoothed: s,
                0.02,
                EMA_SHARE,
                OFFSET_EPSILON,
            )
        np.testing.assert_array_equal(state.steps, expected.steps, err_msg=str(number))
        for name in ("value", "first", "second", "average"):
            got, want = getattr(state, name), getattr(expected, name)
            np.testing.assert_allclose(got, want, rtol=1e-4, atol=2e-6, err_msg=f"{number} {name}")
            kept = before.steps == state.steps
            assert 10 < kept.sum() < TRIANGLES / 2
            np.testing.assert_array_equal(
                got[kept].view(np.uint32), getattr(before, name)[kept].view(np.uint32)
            )


def test_splats_by_triangle_lists_each_once() -> None:
    """Catches a splat left out, or on another triangle, where some triangles have none."""
    face = np.random.default_rng(3).integers(2, 17, 60).astype(np.int32)
    table = splats_by_triangle(face, 20)
    for triangle in range(20):
        found = table[table[triangle] : table[triangle + 1]]
        np.testing.assert_array_equal(found, np.flatnonzero(face == triangle))
