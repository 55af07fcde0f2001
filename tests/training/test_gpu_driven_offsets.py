"""Training of driven offsets by the WebGPU kernels, on software Vulkan where there is no GPU, against the
CPU's."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stga_addon.capture.model import Capture
from stga_addon.raster.gpu import rasterize
from stga_addon.raster.gpu.device import Device
from stga_addon.training.optimize.cpu_backend import CpuBackend
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.optimize.gpu_backend import GpuBackend
from stga_addon.training.optimize.state import OffsetState, TrainState, arrays_of, keep_rows
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.session import train
from stga_addon.training.settings import TrainingSettings

from .test_driven_offsets import squeezed
from .test_gpu_backend import batch_of, disturbed, settings_of
from .test_run import assert_same_state, make_run, stop_at
from .test_trainer import view_of
from .toys import bits

pytestmark = pytest.mark.needs("adapter")

WHITE = np.ones(3, np.float32)


def following(state: TrainState) -> OffsetState:
    return state.driven_offsets["strain_position"]


def state_of(capture: Capture, settings: TrainingSettings) -> TrainState:
    """In the middle of training; the average of how positions follow strain is far from the latest values."""
    state, rng = disturbed(capture, settings), np.random.default_rng(5)
    shape = len(capture.faces), 3, 3
    state.driven_offsets["strain_position"] = OffsetState(
        value=rng.normal(0, 2e-3, shape).astype(np.float32),
        first=np.zeros(shape, np.float32),
        second=np.zeros(shape, np.float32),
        average=rng.normal(0, 2e-3, shape).astype(np.float32),
        steps=(np.arange(len(capture.faces)) % 7).astype(np.int32),
    )
    return state


def pair(capture: Capture, settings: TrainingSettings) -> tuple[CpuBackend, GpuBackend]:
    """Both implementations with the same splats."""
    frames = FrameStore(capture, settings.convention, True)
    cpu = CpuBackend(settings, frames, state_of(capture, settings))
    return cpu, GpuBackend(Device(), settings, frames, state_of(capture, settings))


def position_settings(**changes: Any) -> TrainingSettings:
    return settings_of(driven_offsets=("strain_position",), **changes)


def every_bit(state: TrainState) -> dict[str, np.ndarray]:
    """A copy of every value by name, so that equal ones have equal bits; gradients left out."""
    position = {name: table.copy().view(np.uint32) for name, table in vars(following(state)).items()}
    return {**bits(state), **{f"strain_position/{name}": table for name, table in position.items()}}


def assert_near(got: TrainState, want: TrainState) -> None:
    """All values and moments, as shares of the largest of their name."""
    for name, expected in vars(following(want)).items():
        off = np.abs(getattr(following(got), name) - expected)
        assert (off <= 2e-4 * np.abs(expected).max()).all(), name
    np.testing.assert_array_equal(following(got).steps, following(want).steps)
    found = arrays_of(got)
    for name, array in arrays_of(want).items():
        if not name.startswith("gradients/"):
            expected = array.astype(float)
            off = np.abs(found[name] - expected)
            assert (off <= 1e-3 * np.abs(expected).max(initial=0)).all(), name


@pytest.mark.parametrize("strain_color", [True, False])
@pytest.mark.parametrize("part", [None, "mouth"])
def test_iterations_are_the_cpus(toy: Capture, part: str | None, strain_color: bool) -> None:
    """Catches splats that are not moved, a gradient of other splats or with that of the limits, strain that is
    there for colors only, and another timestep's strain: over a few iterations, whole and local."""
    capture, settings = squeezed(toy), position_settings(strain_color=strain_color)
    cpu, gpu = pair(capture, settings)
    before = every_bit(cpu.state)
    selected = None if part is None else capture.regions[part]
    for timestep in (1, 3, 1):
        batch = batch_of(capture, settings, timestep, selected=selected)
        cpu.step(batch)
        gpu.step(batch)
    assert_near(gpu.state, cpu.state)
    after = every_bit(gpu.state)
    moved = (before["strain_position/value"] != after["strain_position/value"]).any((1, 2))
    assert moved.any()
    if selected is not None:
        assert not moved[~selected].any()
    assert (moved == (following(gpu.state).steps != following(state_of(capture, settings)).steps)).all()


def test_the_first_gradient_is_the_cpus(toy: Capture) -> None:
    """Catches an error of the gradient that Adam's division hides: the first moment is a tenth of it."""
    capture, settings = squeezed(toy), position_settings()
    cpu, gpu = pair(capture, settings)
    for backend in (cpu, gpu):
        backend.step(batch_of(capture, settings))
    got, want = (following(backend.state).first for backend in (gpu, cpu))
    np.testing.assert_allclose(got, want, atol=2e-4 * np.abs(want).max())
    assert np.abs(want).max() > 0


def test_renders_with_the_average(toy: Capture) -> None:
    """Catches a view of the splats where the latest step, or the mesh alone, puts them."""
    capture, settings = squeezed(toy), position_settings()
    cpu, gpu = pair(capture, settings)
    state = state_of(capture, settings)
    following(state).average *= 20  # centimeters
    cpu.state = gpu.state = state
    view = view_of(capture, 3)
    image = gpu.render(view, WHITE, 3)
    np.testing.assert_allclose(image, cpu.render(view, WHITE, 3), atol=1e-4)
    following(state).average[:] = following(state).value
    gpu.state = state
    assert np.abs(gpu.render(view, WHITE, 3) - image).max() > 0.05


def test_other_splats_on_the_triangles(toy: Capture) -> None:
    """Catches triangles that sum the gradients of the splats which they had before density control."""
    capture, settings = squeezed(toy), position_settings()
    cpu, gpu = pair(capture, settings)
    state = state_of(capture, settings)
    state = keep_rows(state, np.random.default_rng(0).permutation(len(state))[: len(state) // 2])
    gpu.state = state
    cpu.state = state
    for backend in (gpu, cpu):
        backend.step(batch_of(capture, settings))
    assert_near(gpu.state, cpu.state)


def test_states_are_the_same_bits_on_both(toy: Capture) -> None:
    """Catches a checkpoint of one device that the other reads differently, and a state that is no copy."""
    capture, settings = squeezed(toy), position_settings()
    cpu, gpu = pair(capture, settings)
    cpu.step(batch_of(capture, settings))
    gpu.state = cpu.state
    state = gpu.state
    for name, want in every_bit(cpu.state).items():
        np.testing.assert_array_equal(every_bit(state)[name], want, err_msg=name)
    kept = every_bit(state)
    gpu.step(batch_of(capture, settings))
    cpu.state = gpu.state
    np.testing.assert_array_equal(every_bit(state)["strain_position/value"], kept["strain_position/value"])
    cpu.step(batch_of(capture, settings))  # which fails where an array has another type or is read-only
    gpu.state = replace(state, driven_offsets={})
    gpu.step(batch_of(capture, settings))
    assert not gpu.state.driven_offsets


def test_an_iteration_without_room_is_repeated(toy: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a step of an iteration whose pairs did not fit, which has no gradients of its own, or one made twice."""
    capture, settings = squeezed(toy), position_settings()
    batches = [batch_of(capture, settings, t, selected=s) for t, s in ((1, None), (3, toy.regions["mouth"]))]
    results = []
    for capacity in (rasterize.INITIAL_PAIR_CAPACITY, 10):
        monkeypatch.setattr(rasterize, "INITIAL_PAIR_CAPACITY", capacity)
        _, gpu = pair(capture, settings)
        for batch in (*batches, *batches):
            gpu.step(batch)
        results.append(every_bit(gpu.state))
    for name, want in results[0].items():
        np.testing.assert_array_equal(results[1][name], want, err_msg=name)


def test_an_iteration_is_one_submit_of_compiled_kernels(toy: Capture) -> None:
    """Catches work that waits for the host, or a kernel compiled in the time that is given to training."""
    capture, settings, device = squeezed(toy), position_settings(), Device()
    device._kernels = {}  # instead of those that other tests have compiled
    frames = FrameStore(capture, settings.convention, True)
    gpu = GpuBackend(device, settings, frames, state_of(capture, settings))
    compiled = set(device._kernels)
    part = batch_of(capture, settings, selected=capture.regions["mouth"])
    gpu.step(part)
    before = device.dispatches, device.submits, device.waits
    gpu.step(part)
    assert device.dispatches - before[0] <= 35
    assert device.submits - before[1] == 1
    assert device.waits == before[2]
    gpu.render(view_of(capture, 1), WHITE, 3)
    assert set(device._kernels) == compiled


def test_stopped_and_resumed_is_the_unbroken_run(toy: Capture, tmp_path: Path) -> None:
    """Catches coefficients, moments, averages or ages that a checkpoint of a GPU forgets, and sums in the order of
    chance: every bit must agree, across density control."""
    effects = {"driven_offsets": ("strain_position",), "strain_color": True}
    run = replace(make_run(squeezed(toy), "selective", iterations=14, **effects), device="gpu")
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    train(squeezed(toy), whole, run)
    train(squeezed(toy), broken, run, report=stop_at(6))
    assert read_checkpoint(broken).iteration == 6
    train(squeezed(toy), broken, run, resume=True)
    assert_same_state(broken, whole)
    ours, theirs = (following(read_checkpoint(folder).state) for folder in (broken, whole))
    assert theirs.steps.max() > 3
    for name, want in vars(theirs).items():
        np.testing.assert_array_equal(getattr(ours, name), want, err_msg=name)
