"""Refining a region: nothing else changes; a stopped one is continued to the same bits."""

import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusal import refusal

from stga_addon.avatar.file import read_avatar
from stga_addon.files import file_digest, write_npz
from stga_addon.jobs.train import Refine, prepare
from stga_addon.progress import ignore
from stga_addon.training.optimize.state import arrays_of
from stga_addon.training.run import continuation as module
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.continuation import (
    START_FRACTION,
    continued_order,
    continued_settings,
    distinct_timesteps,
    replayed_views,
    starting_state,
    views_of_region,
)
from stga_addon.training.run.folder import Continuation, read_run
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train_run
from stga_addon.training.schedule import learning_rates
from stga_addon.training.settings import Rates, TrainingSettings

from .toys import assert_same_run, one_camera, run_of, stop_at

ITERATIONS = 16


@pytest.fixture(scope="module")
def finished(toy, tmp_path_factory):
    """With strain color, density control and visual-hull points; the avatar is the last state's."""
    out = tmp_path_factory.mktemp("finished") / "run"
    without_held_out = replace(toy, views={"train": toy.views["train"]})
    run = run_of(
        without_held_out,
        iterations=12,
        driven_offsets=("strain_color",),
        lattice=1,
        density_interval=10,
        density_span=(0.0, 1.0),
        stray_reset_interval=4,
        stray_limit=0.3,
        hull_points=True,
    )
    train_run(without_held_out, out, run)
    return out


@pytest.fixture
def parent(finished, toy, tmp_path, monkeypatch):
    """A copy of the finished run, whose density control comes often when it is refined."""
    monkeypatch.setattr(module, "DENSITY_INTERVAL", 4)
    monkeypatch.setattr("stga_addon.training.run.folder.open_run", opening(toy))
    return Path(shutil.copytree(finished, tmp_path / "run"))


def opening(toy):
    """`open_run` for the capture without held-out views, which has no file of its own."""
    from stga_addon.training.run.folder import OpenedRun

    capture = replace(toy, views={"train": toy.views["train"]})
    return lambda folder, flame=None: OpenedRun(read_run(folder), capture, (capture,))


def prepare_refinement(parent, region, frames=None, **changes):
    changes = {"frames": frames, "iterations": ITERATIONS, "device": "cpu", **changes}
    request = Refine(parent / "unused", parent, region, **changes)
    return prepare(request, ignore, lambda line: None)


def refine(parent, out, stop=None, **changes):
    prepared = prepare_refinement(parent, "mouth", **{"growth": 0.5, **changes})

    train_run(prepared.capture, out, prepared.run, prepared.selection, report=stop_at(stop))
    return out


def rows_of(state, keep):
    """Bytes of every array at the rows; without gradients and statistics, which no avatar holds."""
    skipped = ("gradients", "screen_gradient", "gradient_count")
    kept = {name: array for name, array in arrays_of(state).items() if not name.startswith(skipped)}
    return {name: array[keep].view(np.uint8) for name, array in kept.items()}


def test_nothing_outside_the_region_changes_by_one_bit(parent, toy, tmp_path):
    """Catches momentum, averages, density or resets beyond the region, and doing nothing."""
    before = read_avatar(parent / "avatar.npz")
    region = toy.regions["mouth"]
    after = read_avatar(refine(parent, tmp_path / "refined") / "avatar.npz")
    outside = [~region[avatar.splats.face] for avatar in (before, after)]
    assert 0 < outside[0].sum() < len(before.splats)
    for name, old in vars(before.splats).items():
        new = getattr(after.splats, name)
        assert_array_equal(old[outside[0]].tobytes(), new[outside[1]].tobytes(), err_msg=name)
    inside = before.splats.rows(~outside[0]), after.splats.rows(~outside[1])
    assert len(inside[1]) > len(inside[0])
    assert set(np.unique(inside[1].face)) == set(np.unique(inside[0].face))
    for name in ("xyz", "sh", "opacity"):
        assert not np.array_equal(
            getattr(inside[0], name), getattr(inside[1], name)[: len(inside[0])]
        ), name
    states = [read_checkpoint(folder).state for folder in (parent, tmp_path / "refined")]
    kept = [rows_of(state, ~region[state.face]) for state in states]
    for name, old in kept[0].items():
        if not name.startswith("parameters"):  # which start from the average
            assert_array_equal(kept[1][name], old, err_msg=name)


def test_a_stopped_refinement_is_continued_to_the_same_bits(parent, toy, tmp_path):
    """Catches an order, a region or a rate that resuming does not find again."""
    whole = refine(parent, tmp_path / "whole", frames=(1, 3))
    stopped = refine(parent, tmp_path / "stopped", stop=7, frames=(1, 3))
    capture = replace(toy, views={"train": toy.views["train"]})
    train_run(capture, stopped, read_run(stopped), resume=True)
    assert_same_run(stopped, whole)


def test_the_avatar_before_is_the_first_evaluation(parent, toy, tmp_path):
    """Catches a report without what came before, and a region that is not measured apart."""
    prepared = prepare_refinement(parent, "mouth", (1, 3))
    train_run(toy, tmp_path / "refined", prepared.run, prepared.selection)
    first, *_, last = read_metrics(tmp_path / "refined")
    assert (first["iteration"], last["iteration"]) == (0, ITERATIONS)
    assert {"psnr_region", "psnr_frames", "psnr_region_frames", "psnr_other_frames"} <= set(last)
    assert last["psnr"] > first["psnr"]
    assert last["psnr_region"] != first["psnr_region"]


def test_one_cameras_avatar_goes_on_as_it_was_trained(toy, tmp_path):
    """Catches colors off-axis, plausible only, that are trained on, or taken for another avatar
    than the checkpoint's, whose moments are lost then."""
    capture = one_camera(toy)
    run = run_of(capture, iterations=4, sh_degree=0, sh_steps=(), lattice=1)
    train_run(capture, tmp_path / "run", run)
    avatar = tmp_path / "run" / "avatar.npz"
    assert read_avatar(avatar).splats.sh_degree == 2
    continuation = Continuation(tmp_path / "run", file_digest(avatar), 0, 4)
    state = starting_state(continuation, run.settings, len(toy.faces))
    before = read_checkpoint(tmp_path / "run").state
    assert_array_equal(state.parameters.sh, before.average.sh)
    assert_array_equal(state.second.sh, before.second.sh)
    assert before.second.sh.any()


def test_a_region_that_no_camera_faces_is_refused(parent, toy, tmp_path):
    """Catches a refinement without a view to train on, which ends in a traceback."""
    away = np.asarray(toy.neutral)[toy.faces].mean(1)[:, 2] < -0.09
    write_npz(tmp_path / "away.npz", {"weights": away})
    with refusal(r"region '.*away\.npz': faces no training camera from timestep 0 to 4"):
        prepare_refinement(parent, str(tmp_path / "away.npz"))
    with refusal("no training views from timestep 7 to 9"):
        prepare_refinement(parent, "mouth", (7, 9))


def test_without_its_checkpoint_an_avatar_is_refined_as_well(parent, toy, tmp_path):
    """Catches a refinement that needs moments, and one of another avatar than its run.json's."""
    (parent / "checkpoint.npz").unlink()
    after = read_avatar(refine(parent, tmp_path / "refined", growth=0.0) / "avatar.npz").splats
    before = read_avatar(parent / "avatar.npz").splats
    outside = ~toy.regions["mouth"][before.face]
    assert np.array_equal(after.xyz[outside], before.xyz[outside])
    assert not np.array_equal(after.xyz[~outside], before.xyz[~outside])
    prepared = prepare_refinement(parent, "mouth")
    (parent / "avatar.npz").write_bytes(b"")
    with refusal(r"avatar\.npz: has changed"):
        train_run(prepared.capture, tmp_path / "again", prepared.run, prepared.selection)


def test_late_rates_are_the_rest_of_the_schedule():
    """Catches rates that jump where a continuation begins, or end elsewhere than a training's."""
    rates = Rates()
    late = continued_settings(TrainingSettings(iterations=9), "refine", 0.0, None, 5, 0).rates
    for progress in (0.0, 0.3, 1.0):
        expected = learning_rates(rates, START_FRACTION + (1 - START_FRACTION) * progress)
        assert learning_rates(late, progress) == pytest.approx(expected)


def test_order_of_views_continues_and_replays(toy):
    """Catches a resumed order that starts anew, and frames forgotten or too often trained."""
    continuation = Continuation(Path(), "", 1, 1)
    for region, count in ((np.ones(len(toy.faces), bool), 27), (None, 20)):  # to refine, to extend
        whole = list(islice(continued_order(continuation, toy, region, 5), 40))
        assert (
            list(islice(continued_order(continuation, toy, region, 5, start=13), 27)) == whole[13:]
        )
        assert sum(view.timestep == 1 for view in whole) == count
    assert {view.timestep for view in whole} == {0, 1, 3}
    alone = islice(continued_order(Continuation(Path(), "", 0, 9), toy, None, 5), 20)
    assert {view.timestep for view in alone} == {0, 1, 3}


def test_replayed_timesteps_differ_most(toy, monkeypatch):
    """Catches a replay of neighbors alike, and one that grows with the takes' length."""
    offsets = {0: 0.0, 1: 0.001, 2: 0.05, 3: 0.051, 4: -0.04}
    capture = replace(
        toy, expression_mesh=lambda timestep, zero_pose: toy.neutral + offsets[timestep]
    )
    assert distinct_timesteps(capture, list(offsets), 3) == [0, 3, 4]
    view = toy.views["train"][0]
    pairs = np.ndindex(5, 16)
    views = [replace(view, timestep=t, camera_index=c) for t, c in pairs]
    assert len(replayed_views(capture, views)) == 80
    monkeypatch.setattr(module, "REPLAY_VIEWS", 20)
    kept = replayed_views(capture, views)
    assert len(kept) == 20
    assert len({view.camera_index for view in kept}) > 4


def test_views_that_see_the_region(toy):
    """Catches a region that is refined in views from behind, which do not show it: a triangle's
    winding in pixels is the opposite of that seen from outside."""
    views = toy.views["train"]
    for view in views[:3]:
        mesh = toy.mesh(view.timestep)
        pose = view.camera.world_to_camera
        center = -(pose[:3, :3].T @ pose[:3, 3])
        corners = mesh[toy.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        toward = ((center - corners.mean(1)) * normal).sum(1)
        toward /= np.linalg.norm(center - corners.mean(1), axis=1) * np.linalg.norm(normal, axis=1)
        assert views_of_region(toy, [view], toward > 0.5) == [view]
        assert views_of_region(toy, [view], toward < -0.5) == []
