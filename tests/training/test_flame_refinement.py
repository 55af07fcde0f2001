"""FLAME's parameters refined while training: the gradient, what it brings, and who gets to see the refined meshes."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from stga_addon.avatar.embedding import FaceFrames, face_frames, frame_backward
from stga_addon.capture.images import read_image, read_view
from stga_addon.capture.model import Capture
from stga_addon.cli.main import main
from stga_addon.errors import StgaError
from stga_addon.files import read_npz, write_npz
from stga_addon.flame.sequence import read_motion, sequence_mesh
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.training.evaluate.metrics import psnr
from stga_addon.training.optimize.cpu_backend import CpuBackend
from stga_addon.training.optimize.flame_refinement import (
    TRANSLATION_RATE_M,
    Tracking,
    frame_gradient,
    refinable_tracking,
)
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.run.checkpoint import read_checkpoint, write_checkpoint
from stga_addon.training.run.folder import Run, read_run
from stga_addon.training.run.loop import train
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.tracking_file import with_refined_tracking
from stga_addon.training.schedule import view_order

from .heads import TIMESTEPS, write_head
from .toys import quick_settings

Made = tuple[Capture, dict[int, np.ndarray]]
NAMES = ("origin", "rotation", "scale")
WHITE = np.ones(3, np.float32)


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Tracked a few millimeters and degrees off."""
    return write_head(tmp_path_factory.mktemp("lost"))


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return write_head(tmp_path_factory.mktemp("right"), error=0.0)


@pytest.fixture(scope="module")
def kept(right: Made) -> Trainer:
    """Refined from a tracking that is right."""
    return trained(right[0], 300, tracking=True)


@pytest.fixture(scope="module", params=["", "antialiased"])
def finished(right: Made, request: pytest.FixtureRequest) -> Trainer:
    if not request.param:
        trainer: Trainer = request.getfixturevalue("kept")
        return trainer
    return trained(right[0], 300, antialiased=True, tracking=True)


def trained(capture: Capture, iterations: int, **changes: Any) -> Trainer:
    settings = quick_settings("global", iterations=iterations, lattice=1, sh_degree=0, sh_steps=(), **changes)
    trainer = Trainer(capture, settings, {})
    views = capture.views["train"]
    ready = {view.name: read_view(view) for view in views}
    for n, view in zip(range(iterations), view_order(views, 1, 0), strict=False):
        small, image, mask = ready[view.name]
        trainer.step(small, image, n / iterations, mask)
    return trainer


GROUPS = {"expression": slice(0, 2), "root": slice(2, 5), "jaw": slice(8, 11), "translation": slice(17, 20)}
"""Where the numbers of the ball's FLAME stand."""
AWAY = {"expression": 0.5, "root": 0.03, "jaw": 0.1, "translation": 0.002}
"""What they are disturbed by: coefficients, radians, meters."""


def differences(tracking: Tracking, timestep: int, loss: Callable[[], float], step: float) -> np.ndarray:
    """(P,) central differences of a loss; step: meters by which vertices move, about."""
    row, before = tracking.sequence.timesteps.index(timestep), tracking.tracked.copy()
    sizes = step * np.repeat([250.0, 10.0, 1.0], [2, 15, 3])
    found = []
    for number, size in enumerate(sizes):
        values = []
        for sign in (1, -1):
            tracking.tracked = before.copy()
            tracking.tracked[row, number] += sign * size
            values.append(loss())
        found.append((values[0] - values[1]) / (2 * size))
    tracking.tracked = before
    return np.array(found)


def test_the_gradient_from_splats_to_parameters(lost: Made) -> None:
    """Catches a sign, a transposed rotation, a joint or a component taken for another, and what turns or grows a splat
    left out: against differences of a made-up loss of where splats are and how they lie."""
    capture, _ = lost
    tracking = refinable_tracking(capture, "stga")
    generator = torch.Generator().manual_seed(0)
    face = np.random.default_rng(0).integers(0, len(capture.faces), 300)
    xyz, rotation, log_scale = (
        torch.randn(len(face), size, generator=generator, dtype=torch.float64) * spread
        for size, spread in ((3, 0.01), (4, 1.0), (3, 0.5))
    )
    toward, along = (torch.randn(len(face), 3, *more, generator=generator, dtype=torch.float64) for more in ((), (3,)))

    def frames() -> FaceFrames:
        return face_frames(tracking.mesh(3), capture.faces, capture.neutral)

    def loss() -> torch.Tensor:
        origin, turn, scale = (torch.from_numpy(getattr(frames(), name)[face]) for name in NAMES)
        w, x, y, z = (rotation / rotation.norm(dim=1, keepdim=True)).unbind(1)
        own = torch.stack(
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
             2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
             2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1
        ).reshape(-1, 3, 3)  # fmt: skip
        place = scale[:, None] * (turn @ xyz[..., None])[..., 0] + origin
        axes = scale[:, None, None] * turn @ own * log_scale.exp()[:, None]
        return (toward * place).sum() + 0.1 * (along * (axes @ axes.mT)).sum()

    leaves = [tensor.requires_grad_() for tensor in (xyz, rotation, log_scale)]
    gradients = torch.autograd.grad(loss(), leaves)
    splats, asked = (Parameters(*(t.detach().numpy() for t in ts), None, None) for ts in (leaves, gradients))
    parts = frame_gradient(splats, face, asked, np.arange(len(face)), frames())
    found = tracking.gradient(3, frame_backward(tracking.mesh(3), capture.faces, frames(), *parts))
    expected = differences(tracking, 3, lambda: loss().item(), 1e-6)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("name", GROUPS)
def test_the_gradient_points_where_the_image_gets_worse(finished: Trainer, name: str) -> None:
    """Catches a gradient that is right for splats, but not for the loss that is trained: along a disturbance of a
    tracking that was right, against differences of the image loss.

    No closer than this: splats that change places in depth, and their rims, are steps that no gradient tells of.
    """
    trainer, capture = finished, finished.capture
    step, tracking = trainer._backend, trainer.tracking
    assert isinstance(step, CpuBackend)
    assert tracking is not None
    view = next(view for view in capture.views["train"] if view.timestep == 3)
    target, face = read_image(view), trainer.state.face
    row, before, part = tracking.sequence.timesteps.index(3), tracking.tracked.copy(), GROUPS[name]
    away = np.zeros(before.shape[1])
    away[part] = np.random.default_rng(3).normal(0, AWAY[name], part.stop - part.start)

    def differentiate(share: float) -> tuple[np.ndarray, float]:
        tracking.tracked = before.copy()
        tracking.tracked[row] += share * away
        trainer.frames.clear()
        rows, _, loss = step._backward(view, target, WHITE, 0, None)
        assert loss is not None
        return rows, loss

    slope = (differentiate(1.15)[1] - differentiate(0.85)[1]) / 0.3
    rows, _ = differentiate(1.0)
    state, frames = trainer.state, trainer.frames.of(3)
    asked = frame_gradient(state.parameters, face, state.gradients, rows, frames)
    found = tracking.gradient(3, frame_backward(trainer.frames.mesh(3), capture.faces, frames, *asked))
    tracking.tracked = before
    trainer.frames.clear()
    assert slope > 0
    assert 0.7 < found @ away / slope < 1.2


def test_a_timestep_moves_only_by_its_own_views(right: Made) -> None:
    """Catches timesteps that a run has not come to yet and that move with those it has, and a decay that draws a
    timestep to minus what others moved by: against Adam's first step, which is the rate, and the tracked values."""
    tracking = refinable_tracking(right[0], "stga")
    still = np.zeros_like(tracking.mesh(0))
    tracking.step(0, still + np.eye(3)[0], 1.0)
    tracking.step(2, still, 1.0)
    moved = (tracking.parameters() - tracking.tracked) / TRANSLATION_RATE_M
    np.testing.assert_allclose(moved[:, GROUPS["translation"].start], [-0.5, 0.5, 0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(moved[2:], 0.0)
    for _ in range(500):
        tracking.step(2, still, 1.0)
    moved = tracking.parameters() - tracking.tracked
    assert np.abs(moved[:, GROUPS["translation"].start]).max() < 1e-3 * TRANSLATION_RATE_M


def millimeters(trainer: Trainer, true: dict[int, np.ndarray]) -> float:
    """Mean distance of the training timesteps' vertices from where they should be."""
    away = [trainer.frames.mesh(timestep) - true[timestep] for timestep in TIMESTEPS[:-1]]
    return 1000 * float(np.linalg.norm(away, axis=-1).mean())


def held_out(trainer: Trainer) -> float:
    views = trainer.capture.views["val"]
    return float(np.mean([psnr(trainer.render(view), read_image(view)) for view in views]))


def test_what_it_brings(lost: Made) -> None:
    """Catches steps that lead nowhere, or past the aim: the mesh comes closer, and so do pictures of an unseen view."""
    capture, true = lost
    on, off = (trained(capture, 300, tracking=tracking) for tracking in (True, False))
    assert on.tracking is not None
    assert millimeters(off, true) > 3.0
    assert millimeters(on, true) < 0.45 * millimeters(off, true)
    assert held_out(on) > held_out(off) + 1.5
    common = on.tracking.parameters() - on.tracking.tracked
    assert np.abs(common[:-1].mean(0)).max() < 1e-12  # what all have in common, an unseen timestep would not follow
    np.testing.assert_array_equal(common[-1], 0)


def test_what_it_costs_where_nothing_is_wrong(right: Made, kept: Trainer) -> None:
    """Catches a drift away from a tracking that is right."""
    capture, true = right
    assert millimeters(kept, true) < 0.8  # a third of a pixel
    assert held_out(kept) > held_out(trained(capture, 300)) - 0.1


def test_nothing_moves_before_there_is_something_to_see(lost: Made) -> None:
    """Catches a tracking that follows gray splats, and one that moves in local iterations."""
    capture, _ = lost
    trainer = Trainer(
        capture,
        quick_settings("selective", warm_up_share=0.0, global_interval=2, tracking=True),
        {0: np.arange(320) < 9},
    )
    view = next(view for view in capture.views["train"] if view.timestep == 0)
    assert trainer.tracking is not None
    steps = trainer.tracking.state.steps
    for progress, expected in ((0.1, 0), (0.5, 0), (0.5, 1), (0.5, 1)):  # the third is a global one
        trainer.step(view, read_image(view), progress)
        assert steps.tolist() == [expected, 0, 0, 0, 0]


@pytest.fixture(scope="module")
def run_folder(lost: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unbroken run."""
    out = tmp_path_factory.mktemp("tracked") / "run"
    train(lost[0], out, make_run(lost[0]))
    return out


def make_run(capture: Capture, **changes: Any) -> Run:
    ours = {"iterations": 40, "lattice": 1, "tracking": True, "driven_offsets": ("strain_position",)}
    settings = quick_settings("global", **{**ours, **changes})
    return Run(capture.root, capture.root / "model.npz", "vhap", settings)


def test_stopped_and_resumed_is_the_unbroken_run(lost: Made, run_folder: Path, tmp_path: Path) -> None:
    """Catches anything of the tracking that a step depends on and a checkpoint does not hold."""
    capture, _ = lost
    train(capture, tmp_path, make_run(capture), report=lambda progress: progress.iteration >= 21)
    train(capture, tmp_path, make_run(capture), resume=True)
    ours, theirs = (read_checkpoint(folder) for folder in (tmp_path, run_folder))
    assert ours.tracking is not None
    assert theirs.tracking is not None
    assert theirs.tracking.steps.sum() == 40 - 6  # none in the first 15 %
    for name, array in vars(theirs.tracking).items():
        np.testing.assert_array_equal(getattr(ours.tracking, name), array, err_msg=name)
    np.testing.assert_array_equal(ours.state.parameters.xyz, theirs.state.parameters.xyz)
    moved, expected = (checkpoint.state.driven_offsets["strain_position"] for checkpoint in (ours, theirs))
    assert moved is not None
    assert expected is not None
    assert np.abs(expected.value).max() > 0
    np.testing.assert_array_equal(moved.value, expected.value)


def test_a_run_and_its_checkpoint_must_agree(lost: Made, run_folder: Path, tmp_path: Path) -> None:
    """Catches a run that continues with the tracked meshes after having been trained on refined ones."""
    run = shutil.copytree(run_folder, tmp_path / "run")
    with pytest.raises(StgaError, match="was begun with other settings"):
        train(lost[0], run, make_run(lost[0], tracking=False), resume=True)
    checkpoint = read_checkpoint(run)
    checkpoint.tracking = None
    write_checkpoint(run, checkpoint)
    with pytest.raises(StgaError, match="its checkpoint's refined tracking does not fit"):
        train(lost[0], run, make_run(lost[0]), resume=True)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("first", np.zeros((5, 7)), r"tracking/first is float64 \(5, 7\), expected float64 \(5, 20\)"),
        ("steps", np.zeros(5), r"tracking/steps is float64 \(5,\), expected int64"),
        ("second", np.full(20, np.nan), "tracking/second holds a value that is not finite"),
        ("change", np.zeros(20), r"tracking/change has shape \(20,\)"),
        ("more", np.zeros(20), "a field is missing or malformed"),
    ],
)
def test_damaged_checkpoints(run_folder: Path, tmp_path: Path, name: str, value: np.ndarray, says: str) -> None:
    """Catches an array that training would go on with to nonsense."""
    arrays = read_npz(run_folder / "checkpoint.npz")
    write_npz(tmp_path / "checkpoint.npz", {**arrays, f"tracking/{name}": value})
    with pytest.raises(StgaError, match=says):
        read_checkpoint(tmp_path)


def test_the_runs_capture_has_the_refined_meshes(lost: Made, right: Made, run_folder: Path) -> None:
    """Catches a quality measured on other meshes than were trained on, meshes of another capture's timesteps, and
    unseen timesteps that are moved."""
    capture, _ = lost
    checkpoint = read_checkpoint(run_folder)
    trainer = Trainer(capture, make_run(capture).settings, {}, checkpoint.state)
    assert trainer.tracking is not None
    assert checkpoint.tracking is not None
    trainer.tracking.state = checkpoint.tracking
    shown = with_refined_tracking(capture, run_folder)
    for timestep in TIMESTEPS[:-1]:
        np.testing.assert_allclose(shown.mesh(timestep), trainer.frames.mesh(timestep), atol=1e-12)
        assert np.abs(shown.mesh(timestep) - capture.mesh(timestep)).max() > 1e-4
    np.testing.assert_array_equal(shown.mesh(TIMESTEPS[-1]), capture.mesh(TIMESTEPS[-1]))
    other = with_refined_tracking(right[0], run_folder)
    np.testing.assert_array_equal(other.mesh(2), right[0].mesh(2))
    assert with_refined_tracking(capture, run_folder.parent) is capture


def test_the_file_is_a_motion(lost: Made, run_folder: Path) -> None:
    """Catches a file that neither `render --motion` nor Blender's Apply Motion could play."""
    capture, _ = lost
    assert capture.flame is not None
    motion = read_motion(run_folder / "tracking.npz", capture.flame.model)
    shown = with_refined_tracking(capture, run_folder)
    assert motion.timesteps == TIMESTEPS
    for timestep in TIMESTEPS:
        np.testing.assert_allclose(sequence_mesh(motion, timestep), shown.mesh(timestep), atol=1e-12)


def test_commands_use_the_refined_meshes(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Catches a command that opens a run's capture past `refined`."""
    best = max(line["psnr"] for line in read_metrics(run_folder))
    assert main(["eval", str(run_folder)]) == 0
    assert f"PSNR {best:.3f} dB" in capsys.readouterr().out
    root = read_run(run_folder).capture
    cameras = ["--cameras", str(root / "transforms_val.json")]
    assert main(["render", str(run_folder), *cameras, "--out", str(tmp_path / "run")]) == 0
    avatar = [str(run_folder / "avatar.npz"), "--capture", str(root), "--flame", str(root / "model.npz")]
    assert main(["render", *avatar, *cameras, "--out", str(tmp_path / "tracked")]) == 0
    assert "was trained on refined meshes" in caplog.text
    ours, theirs = (read_bytes(tmp_path / name) for name in ("run", "tracked"))
    assert ours.keys() == theirs.keys()
    assert all(ours[name] != theirs[name] for name in ours)
    motion = ["--motion", str(run_folder / "tracking.npz")]
    assert main(["render", str(run_folder), *motion, *cameras, "--out", str(tmp_path / "motion")]) == 0
    for name in ours:
        played, shown = (np.asarray(Image.open(tmp_path / kind / name)).astype(int) for kind in ("motion", "run"))
        assert np.abs(played - shown).max() <= 2  # the avatar's neutral mesh is float32


def read_bytes(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_damaged_files(lost: Made, run_folder: Path, tmp_path: Path) -> None:
    """Catches a traceback for a file that was written by something else."""
    arrays = read_npz(run_folder / "tracking.npz")
    for name, value, says in (
        ("timesteps", np.arange(2), "timesteps: expected 5 whole numbers"),
        ("tracked", np.zeros((2, 20)), r"tracked has shape \(2, 20\), expected 5 timesteps first"),
    ):
        write_npz(tmp_path / "tracking.npz", {**arrays, name: value})
        with pytest.raises(StgaError, match=rf"tracking\.npz: {says}"):
            with_refined_tracking(lost[0], tmp_path)


def test_a_run_that_refines_nothing_leaves_nothing(lost: Made, run_folder: Path, tmp_path: Path) -> None:
    """Catches a file of the run that was there before, which the new one's avatar would be shown with."""
    shutil.copy(run_folder / "tracking.npz", tmp_path)
    train(lost[0], tmp_path, make_run(lost[0], tracking=False, iterations=3))
    assert not (tmp_path / "tracking.npz").exists()


def test_where_it_cannot_work(
    toy: Capture,
    lost: Made,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a traceback where there are no parameters, and a GPU that trains on while nothing is refined."""
    with pytest.raises(StgaError, match="is not tracked with FLAME"):
        Trainer(toy, quick_settings("global", tracking=True), {})
    with pytest.raises(StgaError, match="needs the embedding convention 'stga'"):
        Trainer(lost[0], quick_settings("gaussian-avatars", tracking=True), {})
    with pytest.raises(StgaError, match=r"effect tracking=on: .* on the CPU only, not on gpu"):
        Trainer(lost[0], quick_settings("global", tracking=True), {}, device="gpu")
    monkeypatch.setattr("stga_addon.perform.training.choose_device", lambda wanted: ("gpu:Card", "why"))
    root = lost[0].root
    train_on = ["train", str(root), "--flame", str(root / "model.npz"), "--device", "gpu", "--iterations", "2"]
    assert main([*train_on, "--out", str(tmp_path / "run"), "--effect", "tracking=on"]) == 2
    assert "FLAME's parameters are refined on the CPU only" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
