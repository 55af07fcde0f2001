"""States and settings small enough to check by hand."""

import json
import math
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from avatar.conftest import random_splats as random_avatar_splats
from numpy.testing import assert_array_equal

from stga_addon.files import read_npz
from stga_addon.render.render import render
from stga_addon.training.optimize import avatar_tracking
from stga_addon.training.optimize.cpu_backend import CpuBackend
from stga_addon.training.optimize.state import arrays_of, new_state
from stga_addon.training.optimize.step_hook import Schedule
from stga_addon.training.optimize.surface_prior import SurfacePrior
from stga_addon.training.optimize.trainer import _placed_splats
from stga_addon.training.run.folder import CHECKPOINT, RUN, Run
from stga_addon.training.run.metrics_log import METRICS, read_metrics
from stga_addon.training.settings import make_settings


def random_splats(count, faces, seed=0, degree=1):
    made = random_avatar_splats(seed, count, faces, degree)
    return replace(made, xyz=0.01 * made.xyz, log_scale=0.5 * made.log_scale - 3)


def random_state(count, faces, seed=0, degree=1):
    """A state in the middle of training: no two rows alike in anything."""
    state = new_state(random_splats(count, faces, seed, degree))
    rng = np.random.default_rng(seed)
    for part in (state.gradients, state.first, state.second):
        for array in part:
            array[:] = rng.random(array.shape)
    state.steps += np.arange(1, count + 1, dtype=np.int32)
    state.unseen_share += rng.random(count, np.float32)
    state.screen_gradient += rng.random(count, np.float32)
    state.gradient_count += np.arange(1, count + 1, dtype=np.float32)
    return state


def adam_step(arrays, gradient, count, rate, options):
    """Value, first and second moment, float64, after a step by Adam's formula; count: of steps,
    with this one."""
    value, first, second = arrays
    ahead = options.ahead
    first = 0.9 * first + 0.1 * gradient
    second = options.beta2 * second + (1 - options.beta2) * gradient**2
    mean = ((1 - ahead) * first + ahead * gradient) / (1 - (1 - ahead) * 0.9**count)
    deviation = np.sqrt(second / (1 - options.beta2**count))
    return value - rate * mean / (deviation + options.epsilon), first, second


def quick_settings(strategy="selective", **changes):
    """Without visual-hull points, which have tests of their own."""
    return make_settings(strategy, **{"iterations": 100, "hull_points": False, **changes})


def run_of(capture, strategy="global", **changes):
    """A run of a capture, of `quick_settings`."""
    return Run(capture.root, None, "vhap", quick_settings(strategy, **changes))


def one_camera(capture):
    """The capture as the first of its cameras sees it."""
    first, *_ = views = capture.views["train"]
    own = tuple(view for view in views if view.camera_index == first.camera_index)
    return replace(capture, views={"train": own})


def iteration_of(progress):
    return progress.figures().get("iteration", 0)


@contextmanager
def few_renderings():
    """Searches of two renderings, for what does not depend on where tracking leads."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("RENDERINGS", "RENDERINGS_AGAIN", "PYRAMID_RENDERINGS"):
            patch.setattr(avatar_tracking, name, 2)
        yield


def stop_at(iteration):
    """A report that stops a training after so many iterations; None: not at all."""
    return lambda progress: iteration_of(progress) >= (iteration or math.inf)


def assert_same_state(folder, expected):
    """The checkpoints of two runs, bit for bit."""
    ours, theirs = (read_npz(each / CHECKPOINT) for each in (folder, expected))
    counts, right = (json.loads(arrays.pop("meta").tobytes()) for arrays in (ours, theirs))
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        assert_array_equal(array.view(np.uint8), theirs[name].view(np.uint8), err_msg=name)
    for name in ("iteration", "visit", "initial_count", "rounds"):
        assert counts[name] == right[name], name


CLOCKED = ("seconds", "evaluation_s", "wall_s", "peak_memory_mb", "forecast")
"""Fields of a metrics line that depend on how fast the machine was."""


def without_times(lines):
    """Metrics without wall times; sums of float32 rows to seven digits."""
    kept = [{k: v for k, v in line.items() if k not in CLOCKED} for line in lines]
    for line in kept:
        line |= {k: float(f"{v:.7g}") for k, v in line.items() if k.startswith(("loss", "ssim"))}
    return kept


def assert_same_run(folder, expected):
    """Two runs at their end: states and files bit for bit, and evaluations but for times."""
    assert_same_state(folder, expected)
    ours, theirs = (
        {path.name: path.read_bytes() for path in each.iterdir()} for each in (folder, expected)
    )
    in_one_only = ours.keys() ^ theirs.keys()
    assert not in_one_only, in_one_only
    for name, content in ours.items():
        assert content == theirs[name] or name in (CHECKPOINT, METRICS, RUN), name
    lines, right = (without_times(read_metrics(each)) for each in (folder, expected))
    assert lines == right


def alpha_of(splats, camera, frames):
    """(H, W) of splats in these triangles' frames."""
    black, white = (render(splats, camera, (c, c, c), frames=frames).mean(0) for c in (0, 1))
    return 1 - white + black


class Rows(CpuBackend):
    """The rows of a state alone; columns are copies that cannot be written to, as a device's."""

    def __init__(self, state):
        self.state = state

    def columns(self, names, rows=None):
        found = {name: array.copy() for name, array in super().columns(names, rows).items()}
        for array in found.values():
            array.setflags(write=False)
        return found


def state_in(frames, settings):
    """As a training of the capture begins."""
    return _placed_splats(frames, settings)[0]


def settle(frames, state, iteration=20):
    """What nothing shows becomes plausible, as a training does it now and then."""
    SurfacePrior(frames).apply(Rows(state), Schedule(iteration, 0.5, len(state)))


def hidden_layer_size(frames):
    """How many splats lie on triangles that no camera faces: points of a lattice at most as far
    apart as visual-hull points, 15 a triangle at most."""
    capture = frames.capture
    corners = np.asarray(capture.neutral)[capture.faces[frames.surface.hidden]]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    leg = np.sqrt(np.linalg.norm(sides, axis=1))
    rows = np.clip(np.ceil(leg / frames.voxel), 1, 4).astype(int) + 1
    return int((rows * (rows + 1) // 2).sum())


def bits(state):
    """Every array as bytes per row, so that NaN and −0 compare; without gradients."""
    arrays = {
        name: array for name, array in arrays_of(state).items() if not name.startswith("gradients")
    }
    return {
        name: array.copy().reshape(len(state), -1).view(np.uint8) for name, array in arrays.items()
    }


def assert_only_selected_changed(before, after, selected):
    """Rows (`bits`) that are not selected stay bit by bit; most of the others are trained."""
    for name in before:
        assert_array_equal(after[name][~selected], before[name][~selected], err_msg=name)
    for name in ("parameters/xyz", "parameters/sh", "first/opacity", "second/rotation", "steps"):
        changed = (after[name] != before[name]).any(axis=1)
        # those on the far side of the ball may be invisible
        assert changed[selected].mean() > 0.3, name
