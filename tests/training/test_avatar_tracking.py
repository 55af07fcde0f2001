"""A head tracked by its avatar, finished or in training: gradient, gain, who sees it."""

import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_line import refused, stga
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from raster.reference import rotation_matrix
from refusal import refusal
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import face_frames, frame_backward
from stga_addon.avatar.file import read_avatar
from stga_addon.capture.mesh_geometry import silhouette
from stga_addon.capture.open import open_capture
from stga_addon.files import read_npz, write_npz
from stga_addon.flame.forward import parameters_gradient
from stga_addon.flame.sequence import with_identity
from stga_addon.jobs.finished_run import measure_run
from stga_addon.progress import Cancelled
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.tracking.folder import is_in_order
from stga_addon.tracking.solve import RIGID_SIZE, WEIGHT_EXCESS_SIGMA
from stga_addon.training.evaluate import evaluator
from stga_addon.training.evaluate.metrics import evaluate_avatar
from stga_addon.training.optimize import avatar_tracking
from stga_addon.training.optimize.avatar_tracking import (
    OtherRecording,
    RefinedTracking,
    track_by_avatar,
    tracked_timesteps,
)
from stga_addon.training.optimize.cpu_backend import frame_gradient
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.run import session
from stga_addon.training.run.checkpoint import read_checkpoint, write_checkpoint
from stga_addon.training.run.folder import read_run, with_refined_tracking
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.report import report_run
from stga_addon.training.run.session import train_run

from .heads import TIMESTEPS, parameters_of, tracked_as, write_head
from .toys import assert_same_run, few_renderings, quick_settings, run_of, stop_at

NAMES = ("origin", "rotation", "scale")
WHITE = np.ones(3, np.float32)


def millimeters(capture, true):
    """(T,) mean distance of a capture's vertices from where they should be."""
    away = [capture.mesh(timestep) - true[timestep] for timestep in TIMESTEPS]
    return 1000 * np.linalg.norm(away, axis=-1).mean(1)


def test_a_finished_avatar_finds_the_head(person, lost):
    """Catches a gradient or a preconditioner with a wrong sign, axis or joint, steps that stop too
    early, and a drift of the last timestep, which is tracked right already."""
    capture, true = lost
    tracking = RefinedTracking(capture, "stga")
    stages = []

    def report(done, total):
        stages.append((done, total))
        return False

    found = track_by_avatar(person, capture, report=report)
    tracking.take(found, TIMESTEPS)
    before = millimeters(capture, true)
    after = millimeters(tracking.refined(capture), true)
    assert (before[:-1] > 2).all()
    assert np.median(after[:-1] / before[:-1]) < 0.4
    assert after[-1] < 1.2  # half a pixel
    assert stages == [(done, len(TIMESTEPS)) for done in range(len(TIMESTEPS))]
    with pytest.raises(Cancelled):
        track_by_avatar(person, capture, report=lambda done, total: done == 2)
    with refusal("another head"):
        track_by_avatar(person, replace(capture, faces=capture.faces[:-1]))


def test_a_timestep_begins_where_the_one_before_led(person, lost, monkeypatch):
    """Catches tracking that begins anew at each timestep, and so never arrives where all of a take
    is off alike; and a start that is worse than as tracked."""
    capture, _ = lost
    starts = {}
    led = np.zeros(0)

    def minimize(self, shots, tracked, start, *_):
        starts[shots[0][0].timestep] = start - tracked
        return start + led, np.eye(len(start))

    def loss(self, values, shots):
        return float(np.abs(values[-1] - wanted)), np.zeros(len(values))

    monkeypatch.setattr(avatar_tracking._Tracker, "_minimize", minimize)
    monkeypatch.setattr(avatar_tracking._Tracker, "_loss", loss)
    tracked = parameters_of(capture, TIMESTEPS[:2])
    led = np.zeros(len(tracked[0]) + 3)
    led[-1] = 0.004
    for better in (True, False):
        wanted = tracked[1][-1] + (0.004 if better else 0.0)
        track_by_avatar(person, capture, TIMESTEPS[:2])
        assert not starts[TIMESTEPS[0]].any()
        assert_allclose(starts[TIMESTEPS[1]], led if better else 0 * led, atol=1e-12)


def test_weights_that_leave_0_to_1_are_pulled_back(monkeypatch):
    """Catches a pull into the range of ARKit's shapes that counts as energy and not in its
    gradient, or the other way round: the search then ends where it begins. Against the minimum
    worked out by hand, where images say nothing."""
    tracked = np.concatenate([[1.4, -0.3, 0.5], np.zeros(RIGID_SIZE)])
    tracker = object.__new__(avatar_tracking._Tracker)
    tracker._head = SimpleNamespace(model=SimpleNamespace(expression_names=("a", "b", "c")))
    tracker._added = 0
    precision = 25.0
    size = len(tracked)
    monkeypatch.setattr(tracker, "_precision", lambda: np.full(size, precision))
    monkeypatch.setattr(tracker, "_gauss_newton", lambda *_: np.zeros((size, size)))
    monkeypatch.setattr(tracker, "_loss", lambda *_: (0.0, np.zeros(size)))
    found, _ = tracker._minimize([], tracked, tracked, avatar_tracking._Effort(60, 0.0))
    pull = WEIGHT_EXCESS_SIGMA**-2
    expected = tracked.copy()
    expected[:2] = (precision * tracked[:2] + pull * np.array([1.0, 0.0])) / (precision + pull)
    assert_allclose(found, expected, atol=1e-6)


def test_without_masks_the_mesh_that_is_tried_cuts(person, lost, tmp_path):
    """Catches images cut by the very mesh whose place is sought, which say that it is right."""
    capture, true = lost
    views = []
    for view in capture.views["train"]:
        mask, image = (np.asarray(Image.open(path)) for path in (view.mask, view.image))
        path = tmp_path / f"{view.timestep}_{view.camera_index}.png"
        Image.fromarray(np.where(mask[..., None] > 0, image, np.uint8(90))).save(path)
        views.append(replace(view, mask=None, image=path))
    bare = replace(capture, views={"train": tuple(views)})
    tracking = RefinedTracking(capture, "stga")
    trained = person._replace(settings=replace(person.settings, backdrop="mesh"))
    tracking.take(track_by_avatar(trained, bare, TIMESTEPS[:-1]), TIMESTEPS[:-1])
    before = millimeters(capture, true)
    after = millimeters(tracking.refined(capture), true)
    assert np.median(after[:-1] / before[:-1]) < 0.6


def test_refined_meshes_cut_what_is_trained_on(right, tmp_path, monkeypatch):
    """Catches images without masks that are cut by the meshes before refinement, also those read
    ahead or kept from then: the head would lose a rim, and get one of the backdrop."""
    capture = right[0]
    views = tuple(replace(view, mask=None) for view in capture.views["train"])
    run = make_run(capture, backdrop="mesh", iterations=16, driven_offsets=())
    errors = iter((2.0, 1.0))
    step = Trainer.step
    moved = []

    def aside(trained, shown, timesteps, *_):
        values = parameters_of(shown, timesteps)
        values[:, -3:] += 0.02
        return tracked_as(timesteps, values)

    def note(trainer, view, image, share, mask, mesh):
        found = step(trainer, view, image, share, mask, mesh)
        mesh = trainer.frames.mesh(view.timestep)
        inside = silhouette(mesh, capture.faces, view.camera)
        assert_array_equal(mask > 0, inside)
        moved.append(np.abs(mesh - capture.mesh(view.timestep)).max() > 0.01)
        return found

    monkeypatch.setattr(session, "track_by_avatar", aside)
    monkeypatch.setattr(session._Session, "_squared_error", lambda self, views: next(errors))
    monkeypatch.setattr(Trainer, "step", note)
    train_run(replace(capture, views={"train": views}), tmp_path, run)
    assert any(moved)
    assert not all(moved)


@pytest.mark.parametrize(("allowed_s", "most"), [(0.5, 2), (30.0, 6), (1000.0, 30)])
def test_time_is_kept_to(
    allowed_s,
    most,
    right,
    person,
    monkeypatch,
):
    """Catches a time that is judged by the first timestep, which costs a fifth of the others, and
    matrices of each timestep that nobody reads."""
    clock = [0.0]

    class Slow:
        solved = 0

        def __init__(self, *_):
            clock[0] = Slow.solved = 0

        def solve(self, timestep):
            clock[0] += 5.0 if Slow.solved else 1.0
            Slow.solved += 1
            return np.full(23, timestep, float), np.eye(23), 0.0

    monkeypatch.setattr(avatar_tracking, "_Tracker", Slow)
    monkeypatch.setattr(avatar_tracking, "perf_counter", lambda: clock[0])
    found = track_by_avatar(person, right[0], range(30), allowed_s)
    assert found.timesteps[0] == 0
    assert 1 < len(found.timesteps) <= most + 1
    assert len(found.timesteps) >= min(most, 5)
    assert clock[0] <= allowed_s + 6.0
    assert found.information.size == 0
    other = track_by_avatar(person, right[0], range(30), recording=OtherRecording())
    assert other.information.shape == (30, 23, 23)


def test_a_long_take_tracks_no_longer_than_it_trains(right):
    """Catches 1,800 frames that a preset of 500 iterations tracks one by one, and short takes that
    are no longer tracked as a whole."""
    capture = right[0]
    settings = quick_settings("global", iterations=500)
    (view, *_) = capture.views["train"]
    long = replace(capture, views={"train": [replace(view, timestep=t) for t in range(1800)]})
    chosen = tracked_timesteps(settings, long, range(1800))
    assert len(chosen) == 100
    assert (chosen[0], chosen[-1]) == (0, 1799)
    assert tracked_timesteps(settings, long, range(12)) == list(range(12))
    assert len(tracked_timesteps(replace(settings, iterations=1), long, range(1800))) == 12
    timed = replace(settings, iterations=None, seconds=5.0)
    assert len(tracked_timesteps(timed, long, range(1800))) == 1800
    four = [replace(view, timestep=t, camera_index=n) for t in range(90) for n in range(8)]
    wide = replace(capture, views={"train": four})
    assert len(tracked_timesteps(settings, wide, range(90))) == 25


@pytest.mark.parametrize("astray_m", [0.0, 0.5])
def test_timesteps_between_change_as_their_neighbors(astray_m, lost):
    """Catches changes that go to the wrong timesteps where a budget allows only some, and a head
    that is thrown away at one timestep, and between it and its neighbors."""
    tracking = RefinedTracking(lost[0], "stga")
    some = tracking.tracked[[0, 3]].copy()
    some[:, 0] += 1, 4
    some[1, -1] += astray_m
    kept = tracking.take(tracked_as((0, 5), some), TIMESTEPS[:-1])
    change = tracking.parameters[:, :-3] - tracking.tracked
    assert_allclose(change[:, 0], [1, 2 / 3, 1 / 3, 0, 0] if astray_m else [1, 2, 3, 4, 0])
    assert_allclose(change[:, -1], 0, atol=1e-12)
    assert kept == ([5] if astray_m else [])


def test_a_change_near_half_a_turn_is_one_of_rotations(lost):
    """Catches axis-angles that are subtracted, where the head faces -z: 3° between the timesteps
    that are tracked became turns by up to half a turn."""
    tracking = RefinedTracking(lost[0], "stga")
    about = np.array([0, np.pi, 0])
    tilt = np.array([0.05, 0, 0])
    turns = [
        Rotation.from_rotvec(about) * Rotation.from_rotvec([0.01 * (-1) ** row, 0.02, 0])
        for row in range(5)
    ]
    own = slice(-18, -15)
    tracking.tracked[:, own] = [turn.as_rotvec() for turn in turns]
    tracking.parameters = np.pad(tracking.tracked, ((0, 0), (0, 3)))
    ends = tracking.tracked[[0, 3]].copy()
    ends[:, own] = [(Rotation.from_rotvec(tilt) * turns[row]).as_rotvec() for row in (0, 3)]
    tracking.take(tracked_as((0, 5), ends), TIMESTEPS[:-1])
    for row, turn in enumerate(turns[:4]):
        now = Rotation.from_rotvec(tracking.parameters[row, -21:-18])
        assert_allclose((now * turn.inv()).as_rotvec(), tilt, atol=1e-9)


def test_time_says_what_images_do_not(right):
    """Catches jitter in depth that a single camera does not see, motion that it does see but that
    is smoothed away, a blurred cut, and shifts and poses that change places."""
    model = right[0].flame.model
    count = 40
    known = np.full(model.n_expression + 3 + 18, 1e-5) ** -2.0
    known[[0, -1]] = 0.1**-2, 0.01**-2
    values = np.zeros((count, model.n_expression + 18))
    noise = np.random.default_rng(0)
    values[count // 2 :, 0] = 3  # a cut
    values[:, -3:] = noise.normal(0, 0.003, (count, 3))
    shift = noise.normal(0, 0.003, (count, 3))
    each = np.tile(np.diag(known), (count, 1, 1))
    smooth = tracked_as(range(count), values, shift=shift, information=each).smoothed(model)
    assert smooth.parameters[:, -1].std() < 0.6 * values[:, -1].std()
    assert_allclose(smooth.parameters[:, 1:-1], values[:, 1:-1], atol=1e-5)
    assert_allclose(smooth.parameters[:, 0], values[:, 0], atol=0.05)
    assert_allclose(smooth.shift, shift, atol=1e-5)


def differences(tracking, timestep, loss, step):
    """(P,) central differences of a loss; step: meters by which vertices move, about."""
    row = tracking.sequence.timesteps.index(timestep)
    before = tracking.parameters.copy()
    sizes = step * np.repeat([250.0, 10.0, 1.0], [2, 15, 3])
    found = []
    for number, size in enumerate(sizes):
        values = []
        for sign in (1, -1):
            tracking.parameters = before.copy()
            tracking.parameters[row, number] += sign * size
            values.append(loss())
        found.append((values[0] - values[1]) / (2 * size))
    tracking.parameters = before
    return np.array(found)


def test_the_gradient_from_splats_to_parameters(lost):
    """Catches a sign, a transposed rotation, a joint or a component taken for another, and what
    turns or grows a splat left out: against differences of a made-up loss of where splats are and
    how they lie."""
    capture, _ = lost
    tracking = RefinedTracking(capture, "stga")
    generator = torch.Generator().manual_seed(0)
    face = np.random.default_rng(0).integers(0, len(capture.faces), 300)
    xyz, rotation, log_scale = (
        torch.randn(len(face), size, generator=generator, dtype=torch.float64) * spread
        for size, spread in ((3, 0.01), (4, 1.0), (3, 0.5))
    )
    toward, along = (
        torch.randn(len(face), 3, *more, generator=generator, dtype=torch.float64)
        for more in ((), (3,))
    )

    def frames():
        return face_frames(tracking.mesh(3), capture.faces, capture.neutral)

    def loss():
        origin, turn, scale = (torch.from_numpy(getattr(frames(), name)[face]) for name in NAMES)
        place = scale[:, None] * (turn @ xyz[..., None])[..., 0] + origin
        axes = scale[:, None, None] * turn @ rotation_matrix(rotation) * log_scale.exp()[:, None]
        return (toward * place).sum() + 0.1 * (along * (axes @ axes.mT)).sum()

    leaves = [tensor.requires_grad_() for tensor in (xyz, rotation, log_scale)]
    gradients = torch.autograd.grad(loss(), leaves)
    splats, asked = (
        Parameters(*(t.detach().numpy() for t in ts), None, None) for ts in (leaves, gradients)
    )
    parts = frame_gradient(splats, face, asked, np.arange(len(face)), frames())
    by_vertex = frame_backward(tracking.mesh(3), capture.faces, frames(), parts)
    found = parameters_gradient(with_identity(capture.flame).model, tracking.frame(3), by_vertex)
    expected = differences(tracking, 3, lambda: loss().item(), 1e-6)
    assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.fixture(scope="module")
def run_folder(lost, tmp_path_factory):
    """An unbroken run."""
    out = tmp_path_factory.mktemp("tracked") / "run"
    with few_renderings():
        train_run(lost[0], out, make_run(lost[0]))
    return out


def make_run(capture, **changes):
    ours = {"iterations": 40, "lattice": 1, "tracking": True}
    changes = {**ours, "driven_offsets": ("strain_position", "strain_scale"), **changes}
    return replace(run_of(capture, **changes), flame=capture.root / "model.npz")


def test_what_it_brings(lost, tmp_path):
    """Catches a training that goes on with the meshes of before, and tracking that leads nowhere:
    meshes come closer to where they should be, and so do pictures of an unseen view."""
    capture, true = lost
    quality = {}
    for on in (True, False):
        train_run(capture, tmp_path / str(on), make_run(capture, tracking=on, iterations=180))
        quality[on] = read_metrics(tmp_path / str(on))[-1]["psnr"]
    refined = with_refined_tracking(capture, tmp_path / "True")
    before = millimeters(capture, true)
    after = millimeters(refined, true)
    assert np.median(after[:-1] / before[:-1]) < 0.7
    assert quality[True] > quality[False] + 1.0
    assert re.search(r"left out gain [1-9]\.\d\d dB", "\n".join(report_run(tmp_path / "True")))


@pytest.mark.parametrize("held_out", ["camera", "timesteps"])
def test_tracking_is_undone_where_what_is_left_out_loses(held_out, right, tmp_path, monkeypatch):
    """Catches tracking that is judged by images that it has fitted, by the wrong sign, or kept
    where the heads were right before; here it moves them by 4 mm."""
    capture = right[0]
    given = []
    if held_out == "timesteps":
        capture = replace(capture, views={**capture.views, "val": ()})
        monkeypatch.setattr(session, "LEFT_OUT_INTERVAL", 2)

    def astray(trained, shown, timesteps, *_):
        seen = (view for views in shown.views.values() for view in views)
        given.append((tuple(timesteps), {view.camera_index for view in seen}))
        values = parameters_of(shown, timesteps)
        values[:, -3:] += 0.004
        return tracked_as(timesteps, values)

    monkeypatch.setattr(session, "track_by_avatar", astray)
    train_run(capture, tmp_path, make_run(capture))
    tracked = TIMESTEPS[:-1] if held_out == "camera" else (0, 3, 5)
    assert given == [(tracked, {0, 1, 2, 3})]  # and no timesteps of other splits afterwards
    checkpoint = read_checkpoint(tmp_path)
    before = RefinedTracking(capture, "stga").parameters
    assert_array_equal(checkpoint.tracking, before)
    said = "\n".join(report_run(tmp_path))
    assert re.search(r"left out lose \d\.\d\d dB, so heads stay as they were tracked", said)
    # timesteps in no order have no neighbors that could say anything
    assert is_in_order(tmp_path) is None
    (tmp_path / "tracking.json").write_text('{"in_order": false}')
    assert is_in_order(tmp_path) is False
    monkeypatch.setattr(session, "is_in_order", lambda root: False)
    train_run(
        replace(capture, views={**capture.views, "val": ()}), tmp_path / "b", make_run(capture)
    )
    assert given[1][0] == TIMESTEPS[:-1]
    assert read_checkpoint(tmp_path / "b").rounds == 2


def test_a_timestep_whose_mattes_failed_is_neither_tracked_nor_scored(tmp_path, caplog):
    """Catches a head that goes where empty masks draw it, by meters, accepted by views that show
    nobody either."""
    capture, _ = write_head(tmp_path / "capture")
    for view in capture.all_views:
        if view.timestep == 3:
            Image.new("L", (view.camera.width, view.camera.height)).save(view.mask)
    train_run(capture, tmp_path / "run", make_run(capture))
    assert "(timestep 3)" in caplog.text
    found = read_checkpoint(tmp_path / "run").tracking
    before = RefinedTracking(capture, "stga").parameters
    assert_array_equal(found[TIMESTEPS.index(3)], before[TIMESTEPS.index(3)])
    assert not np.array_equal(found, before)


def stop_in_tracking(turn):
    """Stops a training in the middle of its avatar's tracking for the nth time: first of training
    timesteps, then of unseen ones."""
    begun = []

    def report(progress):
        if progress.stage.startswith("Tracking by the avatar: 0 of"):
            begun.append(progress)
        in_the_middle = turn < 2 and "Tracking by the avatar: 2 of" in progress.stage
        return len(begun) == turn and (turn == 2 or in_the_middle)

    return report


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize(
    "stops",
    [stop_at(31), stop_in_tracking(1), stop_in_tracking(2)],
    ids=["training", "halfway", "at the end"],
)
def test_stopped_and_resumed_is_the_unbroken_run(stops, lost, run_folder, tmp_path):
    """Catches anything of the tracking that a step depends on and a checkpoint does not hold, a
    step on old meshes before they are tracked, unseen timesteps that stay untracked for ever, and
    evaluations or avatars that an unbroken run would not have."""
    capture, _ = lost
    train_run(capture, tmp_path, make_run(capture), report=stops)
    assert read_checkpoint(tmp_path).rounds < 2
    assert not (tmp_path / "residuals.npz").exists()
    train_run(capture, tmp_path, make_run(capture), resume=True)
    checkpoint = read_checkpoint(tmp_path)
    assert checkpoint.rounds == 2
    assert checkpoint.state.driven_offsets["strain_position"].value.any()
    assert_same_run(tmp_path, run_folder)


def test_quality_is_measured_with_and_without_fitted_heads(lost, tmp_path, monkeypatch):
    """Catches heads fitted to held-out images in a figure that is not called so, also by `stga
    eval`, and fitted heads that are lost where the last state is not the kept one."""
    capture = lost[0]
    views = {"train": [], "test": [], "val": capture.views["val"]}
    for view in capture.views["train"]:
        views["test" if view.timestep == 3 else "train"].append(view)
    capture = replace(capture, views={split: tuple(own) for split, own in views.items()})
    kept = []
    for number in (10, 9):
        out = tmp_path / str(number)
        monkeypatch.setattr(evaluator, "kept_line", lambda lines, _, n=number: lines[:n][-1])
        train_run(capture, out, make_run(capture, iterations=20, driven_offsets=()))
        *_, before, last = read_metrics(out)
        assert "psnr_fitted_heads" not in before
        assert {"ssim_fitted_heads", "detail_difference_fitted_heads"} <= last.keys()
        refined, plain = (with_refined_tracking(capture, out, fitted=f) for f in (True, False))
        assert_array_equal(plain.mesh(3), capture.mesh(3))
        assert np.abs(refined.mesh(3) - capture.mesh(3)).max() > 1e-4
        avatar = read_avatar(out / "avatar.npz")
        found, fitted = measure_run(out, avatar, capture, "val")
        assert fitted.psnr == pytest.approx(last["psnr_fitted_heads"], abs=0.005)
        assert fitted.psnr > found.psnr
        line = read_metrics(out)[number - 1]
        assert found.psnr == pytest.approx(line["psnr"], abs=0.05)
        kept.append(avatar.splats.xyz)
    assert not np.array_equal(*kept)


@pytest.mark.parametrize("timesteps", [(0, 2, 3), (0, 2)])
def test_a_short_take_is_checked_or_called_unchecked(timesteps, right, tmp_path, caplog):
    """Catches tracking that is kept without a check, and without a warning, in short takes."""
    views = right[0].views["train"]
    shown = tuple(view for view in views if view.timestep in timesteps)
    capture = replace(right[0], views={"train": shown})
    train_run(capture, tmp_path, make_run(capture, iterations=4, driven_offsets=()))
    (gain,) = [
        line["tracking_gain_db"] for line in read_metrics(tmp_path) if "tracking_gain_db" in line
    ]
    assert np.isnan(gain) == (len(timesteps) < 3)
    assert ("is kept unchecked" in caplog.text) == (len(timesteps) < 3)


def test_a_run_and_its_checkpoint_must_agree(lost, run_folder, tmp_path):
    """Catches a run that goes on with tracked meshes after it was trained on refined ones."""
    run = shutil.copytree(run_folder, tmp_path / "run")
    with refusal("was begun with other settings"):
        train_run(lost[0], run, make_run(lost[0], tracking=False), resume=True)
    write_checkpoint(run, replace(read_checkpoint(run), tracking=None))
    with refusal("its checkpoint's refined tracking does not fit"):
        train_run(lost[0], run, make_run(lost[0]), resume=True)


def test_the_runs_capture_has_the_refined_meshes(lost, right, run_folder):
    """Catches a quality on other meshes than trained on, and meshes of another capture."""
    capture, _ = lost
    checkpoint = read_checkpoint(run_folder)
    tracking = RefinedTracking(capture, "stga")
    tracking.parameters = checkpoint.tracking
    shown = with_refined_tracking(capture, run_folder)
    for timestep in TIMESTEPS:
        assert_allclose(shown.mesh(timestep), tracking.mesh(timestep), atol=1e-12)
        assert np.abs(shown.mesh(timestep) - capture.mesh(timestep)).max() > 1e-4
    other = with_refined_tracking(right[0], run_folder)
    assert_array_equal(other.mesh(2), right[0].mesh(2))
    assert with_refined_tracking(capture, run_folder.parent) is capture


def test_commands_use_the_refined_meshes(
    run_folder,
    tmp_path,
    capsys,
    caplog,
):
    """Catches a command that opens a run's capture past `refined`."""
    # other tests compare the files of the shared run, to which `eval` would add one
    own = shutil.copytree(run_folder, tmp_path / "own")
    best = max(line["psnr"] for line in read_metrics(own))
    assert stga("eval", own) == 0
    found = re.search(r"PSNR ([\d.]+) dB", capsys.readouterr().out)
    # the avatar that is written lacks offsets that do not show
    assert float(found[1]) == pytest.approx(best, abs=0.01)
    root = read_run(own).capture
    tracked = open_capture(root, root / "model.npz")
    assert stga("eval", own, "--split test") == 0
    avatar = read_avatar(own / "avatar.npz")
    before = evaluate_avatar(avatar, tracked, "test").psnr
    after = evaluate_avatar(avatar, with_refined_tracking(tracked, own), "test").psnr
    said = capsys.readouterr().out
    assert f"heads as tracked, PSNR {before:.3f} dB" in said
    assert f"heads fitted by the avatar to these images: PSNR {after:.3f} dB" in said
    written = json.loads((own / "quality_test.json").read_text())
    assert (written["psnr"], written["psnr_fitted_heads"]) == (before, after)
    to = "--cameras", root / "transforms_val.json", "--out"
    assert stga("render", own, *to, tmp_path / "run") == 0
    capture = "--capture", root, "--flame", root / "model.npz"
    assert stga("render", own / "avatar.npz", *capture, *to, tmp_path / "tracked") == 0
    assert "was trained on refined meshes" in caplog.text
    ours, theirs = (read_bytes(tmp_path / name) for name in ("run", "tracked"))
    assert ours.keys() == theirs.keys()
    assert all(ours[name] != theirs[name] for name in ours)
    still = tmp_path / "still"
    shutil.copytree(own, still)
    arrays = read_npz(still / "tracking.npz")
    # a motion that is played leaves the torso where the capture has it
    write_npz(still / "tracking.npz", {**arrays, "torso_shift": 0 * arrays["torso_shift"]})
    for kind, more in (("played", ("--motion", still / "tracking.npz")), ("shown", ())):
        assert stga("render", still, *more, *to, tmp_path / kind) == 0
    for name in ours:
        pictures = [np.asarray(Image.open(tmp_path / kind / name)) for kind in ("played", "shown")]
        # the avatar's neutral mesh is float32
        assert np.abs(np.diff(np.stack(pictures).astype(int), axis=0)).max() <= 2


def read_bytes(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_damaged_files(lost, run_folder, tmp_path):
    """Catches a traceback for a file that was written by something else."""
    arrays = read_npz(run_folder / "tracking.npz")
    for name, value, says in (
        ("timesteps", np.arange(2), "timesteps: expected 5 whole numbers"),
        ("tracked", np.zeros((2, 20)), r"tracked has shape \(2, 20\), expected 5 timesteps first"),
    ):
        write_npz(tmp_path / "tracking.npz", {**arrays, name: value})
        with refusal(rf"tracking\.npz: {says}"):
            with_refined_tracking(lost[0], tmp_path)


def test_a_run_that_refines_nothing_leaves_nothing(lost, run_folder, tmp_path):
    """Catches a file of the run before, which the new avatar would be shown with."""
    shutil.copy(run_folder / "tracking.npz", tmp_path)
    train_run(lost[0], tmp_path, make_run(lost[0], tracking=False, iterations=3))
    assert not (tmp_path / "tracking.npz").exists()


def test_where_it_cannot_work(
    toy,
    lost,
    tmp_path,
    capsys,
    monkeypatch,
):
    """Catches a traceback without parameters, and a GPU on which nothing is refined."""
    with refusal("is not tracked with FLAME"):
        Trainer(toy, quick_settings("global", tracking=True), {})
    with refusal("needs the embedding convention 'stga'"):
        Trainer(lost[0], quick_settings("gaussian-avatars", tracking=True), {})
    with refusal(r"effect tracking=on: .* on the CPU only, not on gpu"):
        Trainer(lost[0], quick_settings("global", tracking=True), {}, device="gpu")
    monkeypatch.setattr("stga_addon.jobs.train.choose_device", lambda wanted: ("gpu:Card", "why"))
    root = lost[0].root
    gpu = "--device gpu --iterations 2 --effect tracking=on --out"
    assert "FLAME's parameters are refined on the CPU only" in refused(
        capsys, "train", root, "--flame", root / "model.npz", gpu, tmp_path / "run"
    )
    assert not (tmp_path / "run").exists()
