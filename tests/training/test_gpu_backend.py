"""The iteration by the WebGPU kernels, on software Vulkan where there is no GPU, against the CPU's:
states, freezing, whole runs."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from raster import gpu_device
from refusal import refusal

from stga_addon.avatar.offsets import COLOR, OFFSETS
from stga_addon.capture.images import read_image
from stga_addon.errors import DeviceError
from stga_addon.raster.gpu import rasterize
from stga_addon.raster.gpu.device import Device
from stga_addon.training.optimize.backend import Batch, RenderOptions
from stga_addon.training.optimize.cpu_backend import CpuBackend
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.optimize.gpu_backend import GpuBackend
from stga_addon.training.optimize.initial_splats import initial_splats
from stga_addon.training.optimize.state import (
    OffsetState,
    arrays_of,
    keep_rows,
    new_state,
)
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.folder import read_run
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train_run, train_run_or_fall_back
from stga_addon.training.schedule import learning_rates

from .test_driven_offsets import SIZES, squeezed
from .test_run import make_run
from .test_trainer import large, view_of
from .toys import assert_only_selected_changed, assert_same_state, bits, quick_settings, stop_at

pytestmark = pytest.mark.needs("adapter")


def settings_of(**changes):
    """Every term of the loss at work on most splats."""
    limits = {"scale_limit": 0.2, "distance_weight": 0.1, "distance_limit": 0.3}
    limits |= {"unseen_opacity_weight": 0.5, "lattice": 2}
    effects = {"antialiased": True, "driven_offsets": tuple(OFFSETS)}
    return quick_settings("selective", **{**limits, **effects, **changes})


def disturbed(capture, settings):
    """Splats unlike each other, in the middle of training; the averages of driven offsets are far
    from the latest values."""
    state = new_state(initial_splats(capture, settings))
    rng = default_rng(0)
    for value in state.parameters:
        value += rng.normal(0, 1e-3 if value.ndim == 2 else 0.2, value.shape).astype(np.float32)
    state.steps += np.arange(len(state), dtype=np.int32) % 7
    state.unbound[::5] = True
    state.unseen_share[::5] = 0.7
    rng = default_rng(5)
    shape = (len(capture.faces), 3, 3)
    for name in settings.driven_offsets:
        size = SIZES[OFFSETS[name].target]
        state.driven_offsets[name] = OffsetState(
            value=rng.normal(0, size, shape).astype(np.float32),
            first=np.zeros(shape, np.float32),
            second=np.zeros(shape, np.float32),
            average=rng.normal(0, size, shape).astype(np.float32),
            steps=(np.arange(len(capture.faces)) % 7).astype(np.int32),
        )
    return state


def following(state):
    """The arrays of every driven offset."""
    return {
        f"{name}/{part}": array
        for name, offset in state.driven_offsets.items()
        for part, array in vars(offset).items()
    }


def every_bit(state):
    """A copy of every value by name, so that equal ones have equal bits; gradients left out."""
    driven = {name: table.copy().view(np.uint32) for name, table in following(state).items()}
    return {**bits(state), **driven}


def pair(capture, settings):
    """Both implementations with the same splats."""
    frames = FrameStore(capture, settings.convention, True)
    cpu = CpuBackend(settings, frames, disturbed(capture, settings))
    return cpu, GpuBackend(Device(), settings, frames, disturbed(capture, settings))


def batch_of(capture, settings, timestep=1, **changes):
    view = view_of(capture, timestep)
    values = {
        "view": view,
        "target": read_image(view),
        "mask": None,
        "options": RenderOptions(np.ones(3, np.float32), 3),
        "selected": None,
        "rates": learning_rates(settings.rates, 0.0),
    }
    return Batch(**{**values, **changes})


def test_losses_are_the_cpus_and_returned_two_iterations_late(toy):
    """Catches a loss of another iteration, of a local one, or returned twice."""
    settings = settings_of()
    cpu, gpu = pair(toy, settings)
    parts = [(1, None), (3, None), (1, toy.regions["mouth"]), (3, None), (1, None), (3, None)]
    batches = [batch_of(toy, settings, timestep, selected=part) for timestep, part in parts]
    expected, losses = ([step.step(batch) for batch in batches] for step in (cpu, gpu))
    assert [loss is None for loss in losses] == [True, True, False, False, True, False]
    assert [losses[n] for n in (2, 3, 5)] == pytest.approx(
        [expected[n] for n in (0, 1, 3)], rel=1e-3
    )


def test_a_local_iteration_leaves_frozen_rows_bit_identical(toy):
    """Catches momentum, limits or statistics that reach rows which the frame does not select."""
    settings = settings_of()
    _, gpu = pair(toy, settings)
    gpu.step(batch_of(toy, settings))
    before = bits(gpu.state)
    for _ in range(2):
        gpu.step(batch_of(toy, settings, selected=toy.regions["mouth"]))
    state = gpu.state
    assert_only_selected_changed(before, bits(state), toy.regions["mouth"][state.face])


def test_an_iteration_without_room_is_repeated(toy, monkeypatch):
    """Catches an iteration lost, counted twice or half done where buffers were too small."""
    settings = settings_of()
    batches = [
        batch_of(toy, settings, timestep, selected=s)
        for timestep, s in ((1, None), (3, toy.regions["mouth"]))
    ]
    results = []
    for capacity in (rasterize.INITIAL_PAIR_CAPACITY, 10):
        monkeypatch.setattr(rasterize, "INITIAL_PAIR_CAPACITY", capacity)
        _, step = pair(toy, settings)
        for batch in (*batches, *batches):
            step.step(batch)
        results.append(every_bit(step.state))
    assert_equal(results[1], results[0])


@pytest.mark.parametrize("part", [None, "mouth"])
def test_an_iteration_is_one_submit(toy, part):
    """Catches work that waits for the host, or that costs a submit or many dispatches of its
    own."""
    settings = settings_of()
    _, gpu = pair(toy, settings)
    batch = batch_of(toy, settings, selected=None if part is None else toy.regions[part])
    gpu.step(batch)
    device = gpu.device
    before = device.dispatches, device.submits, device.waits
    gpu.step(batch)
    assert device.dispatches - before[0] <= 44
    assert device.submits - before[1] == 1
    assert device.waits == before[2]


def test_everything_is_compiled_before_the_first_iteration(toy):
    """Catches a kernel that is compiled in the time that is given to training."""
    settings = settings_of()
    device = Device()
    device._kernels = {}  # instead of those that other tests have compiled
    frames = FrameStore(toy, settings.convention, True)
    gpu = GpuBackend(device, settings, frames, disturbed(toy, settings))
    compiled = set(device._kernels)
    view, target = large(view_of(toy, 1))
    for part in (None, toy.regions["mouth"]):
        gpu.step(batch_of(toy, settings, selected=part))
    gpu.step(batch_of(toy, settings, view=view, target=target))
    gpu.render(view, RenderOptions(np.ones(3, np.float32), 3))
    assert set(device._kernels) == compiled


def test_a_lost_gpu_is_followed_by_the_cpu(toy, tmp_path, monkeypatch, caplog):
    """Catches a run that ends, begins again or loses its checkpoint where a driver is reset, and a
    CPU unasked."""
    device = f"gpu:{gpu_device.device().name}"
    run = replace(make_run(toy, "selective", iterations=12), device=device)
    train_run(toy, tmp_path, run, report=stop_at(5))
    step = GpuBackend.step
    done = []

    def breaks(self, batch):
        done.append(batch)
        if len(done) == 3:
            raise DeviceError(
                "Card 9000 was lost", "try again, with --device cpu if it happens again"
            )
        return step(self, batch)

    monkeypatch.setattr(GpuBackend, "step", breaks)
    with refusal("Card 9000 was lost; try again, with --device cpu"):
        train_run(toy, tmp_path, run, resume=True)
    assert read_checkpoint(tmp_path).iteration == 5
    done.clear()
    stages = []

    def note(progress):
        return bool(stages.append(progress.stage))

    train_run_or_fall_back(toy, tmp_path, run, resume=True, report=note)
    assert len(done) == 3
    assert "Continuing on the CPU" in stages
    assert "Card 9000 was lost; continuing on the CPU" in caplog.messages
    assert read_checkpoint(tmp_path).iteration == read_metrics(tmp_path)[-1]["iteration"] == 12
    assert read_run(tmp_path).device == "cpu"


def test_states_are_the_same_bits_on_both(toy):
    """Catches a checkpoint of one device that the other reads differently: rows, moments, counts,
    statistics, marks."""
    settings = settings_of()
    cpu, gpu = pair(toy, settings)
    for timestep in (1, 3):
        cpu.step(batch_of(toy, settings, timestep))
    gpu.state = cpu.state
    state = gpu.state
    assert_equal(every_bit(state), every_bit(cpu.state))
    kept = every_bit(state)
    gpu.step(batch_of(toy, settings))
    cpu.state = gpu.state
    assert not np.array_equal(bits(cpu.state)["parameters/xyz"], bits(state)["parameters/xyz"])
    for name in following(state):
        assert_array_equal(every_bit(state)[name], kept[name], err_msg=name)
    # which fails where an array has another type or is not contiguous
    cpu.step(batch_of(toy, settings))
    gpu.state = replace(state, driven_offsets={})
    gpu.step(batch_of(toy, settings))
    assert not gpu.state.driven_offsets


def test_rows_change_as_the_cpus(toy):
    """Catches rows mixed up, columns of other fields, moments and ages left behind, gradients of
    offsets summed over the splats of before, and changes that take all splats to the host."""
    settings = settings_of()
    cpu, gpu = pair(toy, settings)
    gpu.step(batch_of(toy, settings))
    cpu.state = gpu.state
    rng = default_rng(2)
    count = len(cpu)
    third = np.arange(count) % 3 == 1
    color = rng.normal(size=(third.sum(), 3)).astype(np.float32)
    scale = rng.normal(size=(7, 3)).astype(np.float32)
    order = rng.integers(0, count, 2 * count)  # more than there were, some several times
    few = np.arange(3, 10)
    for backend in (cpu, gpu):
        backend.assign(third, {"average/sh": 0.25, "parameters/color": color})
        backend.keep(order)
        backend.assign(few, {"first/log_scale": scale, "second/opacity": 3.0, "steps": 5})
        backend.keep(np.arange(2 * count) % 5 != 1)
    waits = gpu.device.waits
    names = ["parameters/color", "second/sh", "steps", "face", "screen_gradient"]
    found = gpu.columns(names)
    assert gpu.device.waits == waits + 1
    assert_equal(found, cpu.columns(names))
    assert_equal(gpu.columns(names, order[:9]), cpu.columns(names, order[:9]))
    assert_equal(every_bit(gpu.state), every_bit(cpu.state))
    batch = batch_of(toy, settings, 3)
    assert_allclose(gpu.blend_weights(batch.view), cpu.blend_weights(batch.view), atol=1e-2)
    assert gpu.blend_weights(batch.view).max() > 1
    for backend in (cpu, gpu):
        backend.step(batch)
    assert_near(gpu.state, cpu.state)


def assert_near(got, want):
    """All values and moments, as fractions of the largest of their name."""
    for name, expected in following(want).items():
        off = np.abs(following(got)[name] - expected)
        assert (off <= 0 if name.endswith("steps") else 2e-4 * np.abs(expected).max()).all(), name
    found = arrays_of(got)
    for name, array in arrays_of(want).items():
        if not name.startswith("gradients/"):
            expected = array.astype(float)
            off = np.abs(found[name] - expected)
            assert (off <= 1e-3 * np.abs(expected).max(initial=0)).all(), name


@pytest.mark.parametrize(
    ("part", "offsets"),
    [
        (None, tuple(OFFSETS)),
        ("mouth", tuple(OFFSETS)),
        ("mouth", ("strain_position",)),
        (None, ("normal_color",)),
    ],
)
def test_iterations_are_the_cpus(toy, part, offsets):
    """Catches splats not moved or colored, others' gradients, another timestep's signal, and a
    background that differs."""
    capture = squeezed(toy)
    settings = settings_of(driven_offsets=offsets)
    cpu, gpu = pair(capture, settings)
    before = every_bit(cpu.state)
    selected = None if part is None else capture.regions[part]
    # All or nothing: a mixture may lie between two bytes, and either is right.
    size = read_image(view_of(capture, 1)).shape[:2]
    masked = {
        "mask": 255 * default_rng(1).integers(0, 2, size, np.uint8),
        "options": RenderOptions(np.float32([0.13, 0.82, 0.43]), 3),
    }
    for timestep, changes in ((1, {}), (3, masked), (1, {})):
        batch = batch_of(capture, settings, timestep, selected=selected, **changes)
        cpu.step(batch)
        gpu.step(batch)
    assert_near(gpu.state, cpu.state)
    after = every_bit(gpu.state)
    for name in offsets:
        moved = (before[f"{name}/value"] != after[f"{name}/value"]).any((1, 2))
        assert moved.any()
        if selected is not None:
            assert not moved[~selected].any()
        assert not moved[before[f"{name}/steps"] == after[f"{name}/steps"]].any()


def test_triangles_left_out_do_not_follow(toy, monkeypatch):
    """Catches splats of a mouth that was never open that move with its strain, before and after
    density control: every second triangle is left out."""
    capture = squeezed(toy)
    settings = settings_of()
    left_out = np.arange(len(capture.faces)) % 2 == 0
    monkeypatch.setattr(
        FrameStore, "is_trained", lambda _, offset: ~left_out | (offset.target == COLOR)
    )
    for backend in pair(capture, settings):
        before = {name: array.copy() for name, array in following(backend.state).items()}
        backend.step(batch_of(capture, settings))
        backend.keep(np.arange(len(backend)) % 3 > 0)
        backend.step(batch_of(capture, settings))
        after = following(backend.state)
        for name, offset in OFFSETS.items():
            moved = (before[f"{name}/value"] != after[f"{name}/value"]).any((1, 2))
            assert moved[~left_out].any()
            assert moved[left_out].any() == (offset.target == COLOR), name


def test_renders_with_the_average(toy):
    """Catches a view of the latest step, and gradients summed over splats of before density."""
    capture = squeezed(toy)
    settings = settings_of()
    cpu, gpu = pair(capture, settings)
    state = disturbed(capture, settings)
    for offset in state.driven_offsets.values():
        offset.average *= 10
    cpu.state = gpu.state = state
    view = view_of(capture, 3)
    options = RenderOptions(np.ones(3, np.float32), 3)
    image = gpu.render(view, options)
    assert_allclose(image, cpu.render(view, options), atol=1e-4)
    for offset in state.driven_offsets.values():
        offset.average[:] = offset.value
    gpu.state = state
    assert np.abs(gpu.render(view, options) - image).max() > 0.01  # a hundred times the tolerance
    state = disturbed(capture, settings)
    state = keep_rows(state, default_rng(0).permutation(len(state))[: len(state) // 2])
    gpu.state = state
    cpu.state = state
    for backend in (gpu, cpu):
        backend.step(batch_of(capture, settings))
    assert_near(gpu.state, cpu.state)


def test_stopped_and_resumed_is_the_unbroken_run(toy, tmp_path):
    """Catches coefficients, moments, averages or ages that a checkpoint of a GPU forgets, and sums
    in the order of chance: every bit must agree, across density control."""
    effects = {"driven_offsets": tuple(OFFSETS), "density_interval": 3}
    run = replace(make_run(squeezed(toy), "selective", iterations=6, **effects), device="gpu")
    broken = tmp_path / "broken"
    whole = tmp_path / "whole"
    train_run(squeezed(toy), whole, run)
    train_run(squeezed(toy), broken, run, report=stop_at(4))
    assert read_checkpoint(broken).iteration == 4
    train_run(squeezed(toy), broken, run, resume=True)
    assert_same_state(broken, whole)
    assert following(read_checkpoint(whole).state)["strain_color/steps"].max() > 3
