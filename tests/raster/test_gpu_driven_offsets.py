"""Adam on driven offsets on a WebGPU device against the CPU's."""

from copy import deepcopy

import numpy as np
import pytest

from raster import gpu_device
from stga_addon.raster.gpu import driven_offsets as on_device
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.driven_offsets import OffsetTables, splats_by_triangle
from stga_addon.raster.gpu.layout import VIEW
from stga_addon.raster.gpu.optimizer import upload_step
from stga_addon.training.optimize import driven_offsets as on_cpu
from stga_addon.training.optimize.adam import BETA1, BETA2
from stga_addon.training.optimize.state import OffsetState

from .test_gpu_optimizer import RATES, STRIDE

pytestmark = pytest.mark.needs("adapter")

NAME = "strain_position"
TRIANGLES, SPLATS = 300, 900
EPSILON, EMA_SHARE = np.float32(1e-3), 0.02


@pytest.fixture(scope="module")
def device() -> Device:
    return gpu_device.device()


def random_state(seed: int = 0) -> OffsetState:
    """Triangles of any age."""
    rng = np.random.default_rng(seed)
    value, first, second, average = rng.normal(size=(4, TRIANGLES, 3, 3)).astype(np.float32)
    return OffsetState(value, first, second**2, average, rng.integers(0, 3000, TRIANGLES).astype(np.int32))


def stepped(
    device: Device, state: OffsetState, face: np.ndarray, wanted: np.ndarray, gradients: np.ndarray,
    smoothed: np.ndarray, rate: float,
) -> OffsetState:  # fmt: skip
    """The state after a step on the device."""
    view = np.zeros(1, VIEW)
    view["splats"], view["coefficients"], view["strain_colors"] = SPLATS, 4, 2
    rates = {**RATES, "xyz": rate}
    upload_step(device, rates, (BETA1, BETA2), EPSILON, EMA_SHARE, (0, 0, 0), False, TRIANGLES)
    tables = OffsetTables(
        **{name: device.upload(f"test position {name}", table) for name, table in vars(state).items()},
        splats_of=device.upload("test splats by triangle", splats_by_triangle(face, TRIANGLES)),
    )
    with device.record() as work:
        on_device.step(
            work, TRIANGLES, {NAME: tables}, {NAME: device.upload("test signal", smoothed)},
            view=device.upload("view", view, "uniform"), gradients=device.upload("test gradients", gradients),
            wanted=device.upload("test wanted", wanted.astype(np.uint32)),
        )  # fmt: skip
    arrays = vars(state).items()
    return OffsetState(**{k: device.read(getattr(tables, k), was.shape, was.dtype) for k, was in arrays})


def test_a_step_is_the_cpus(device: Device) -> None:
    """Catches gradients of splats that were not trained or of other triangles, a wrong age, rate or average, a broken
    gradient that gets in, and a triangle stepped that is not to be: over several steps."""
    rng, state = np.random.default_rng(1), random_state()
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
            on_cpu.step({NAME: expected}, rows, face, xyz, lambda _, s=smoothed: s, 0.02, EMA_SHARE, EPSILON)
        np.testing.assert_array_equal(state.steps, expected.steps, err_msg=str(number))
        for name in ("value", "first", "second", "average"):
            got, want = getattr(state, name), getattr(expected, name)
            np.testing.assert_allclose(got, want, rtol=1e-4, atol=2e-6, err_msg=f"{number} {name}")
            kept = before.steps == state.steps
            assert 10 < kept.sum() < TRIANGLES / 2
            np.testing.assert_array_equal(got[kept].view(np.uint32), getattr(before, name)[kept].view(np.uint32))


def test_splats_by_triangle_lists_each_once() -> None:
    """Catches a splat left out, or on another triangle, where some triangles have none."""
    face = np.random.default_rng(3).integers(2, 17, 60).astype(np.int32)
    table = splats_by_triangle(face, 20)
    for triangle in range(20):
        found = table[table[triangle] : table[triangle + 1]]
        np.testing.assert_array_equal(found, np.flatnonzero(face == triangle))
