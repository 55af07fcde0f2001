"""Performances on the command line: rendered, exported, and converted."""

import shutil

import numpy as np
import pytest
from capture.factory import write_flame_capture
from command_line import refused, stga
from flame.small_head import small_head, write_flame
from numpy.testing import assert_allclose
from PIL import Image
from scipy.spatial.transform import Rotation
from tracking.test_calibrations import entry

from stga_addon.avatar.file import Avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.capture.camera import look_at
from stga_addon.capture.open import open_capture
from stga_addon.driving.inverse import write_performance
from stga_addon.driving.performance import COLUMN, Performance
from stga_addon.driving.performers import read_performance
from stga_addon.export.playback import DEFAULT_FPS
from stga_addon.files import write_json
from stga_addon.flame.forward import flame_forward, neutral_frame
from stga_addon.flame.parts import flame_model
from stga_addon.flame.sequence import read_motion, sequence_mesh
from stga_addon.jobs.track import MAX_MISFIT
from stga_addon.render.video import video_writer
from stga_addon.tracking.folder import AVATAR_MISFIT, FOOTAGE_FILE, REPORT_FILE
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.footage.sequences import FrameRange
from stga_addon.tracking.opened import footage_state
from stga_addon.training.run.folder import AVATAR, Run, avatar_version, write_run
from stga_addon.training.settings import TrainingSettings

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The small head's model, an avatar of it, and a take that turns and opens the jaw."""
    folder = tmp_path_factory.mktemp("drive")
    model = small_head(0)
    write_flame(model, folder / "flame.npz")
    neutral = flame_forward(model, np.full(model.n_identity, 0.5), neutral_frame(model))
    neutral = neutral.astype(np.float32)
    splats = lattice_splats(neutral, model.faces, order=0)
    write_avatar(folder / "a.npz", Avatar(splats, "stga", neutral, model.faces))
    weights = np.zeros((10, 52))
    weights[:, COLUMN["jawOpen"]] = np.linspace(0, 0.9, 10)
    weights[:, COLUMN["jawLeft"]] = np.linspace(0, 0.5, 10)
    weights[:, COLUMN["eyeLookOutLeft"]] = np.linspace(0, 1, 10)
    head = np.linspace([0, 0, 0], [0.4, 0, 0.2], 10)
    write_performance(folder / "take.csv", Performance(np.arange(10) / 30, weights, head, 30.0))
    camera = look_at(np.array([0.0, 0.0, 0.8]), np.zeros(3), 64, 64, 130.0)
    frame = entry(camera, "x.png", timestep_index=0, camera_index=0)
    write_json(folder / "cameras.json", {"frames": [frame]})
    return {name: folder / name for name in ("flame.npz", "a.npz", "take.csv", "cameras.json")}


def test_convert_there_and_back(files, tmp_path, capsys):
    """Catches an unreadable or refitted motion, another rate, gaze without eyeballs, and a mirror
    or strength without effect."""
    out = tmp_path / "motion.npz"
    back = tmp_path / "back.csv"
    flame = files["flame.npz"]
    assert stga("drive", files["take.csv"], "--flame", flame, "--fps", 60, "--out", out) == 0
    model = small_head(0)
    motion = read_motion(out, model)
    assert len(motion.timesteps) == 19
    drop = sequence_mesh(motion, 18) - sequence_mesh(motion, 0)
    assert drop[:, 1].min() < -0.008
    assert stga("drive", out, "--flame", flame, "--mirror", "--out", back) == 0
    weights = read_performance(back).weights
    assert_allclose(weights[-1, COLUMN["jawOpen"]], 0.9, atol=0.01)
    assert_allclose(weights[-1, COLUMN["jawRight"]], 0.5, atol=0.01)
    weak = f"--flame {flame} --strength 0.5 --out"
    assert stga("drive", files["take.csv"], "--strength 0.5 --out", tmp_path / "weak.csv") == 0
    assert stga("drive", files["take.csv"], weak, tmp_path / "weak.npz") == 0
    assert stga("drive", tmp_path / "weak.npz", weak, tmp_path / "weaker.csv") == 0
    for output, share in (("weak.csv", 0.5), ("weaker.csv", 0.25)):
        found = read_performance(tmp_path / output)
        assert_allclose(found.weights[-1, COLUMN["jawOpen"]], 0.9 * share, atol=0.01)
        assert_allclose(found.head[-1], [0.4 * share, 0, 0.2 * share], atol=0.01)
    assert "holds FLAME parameters already" in refused(
        capsys, "drive", out, "--out", tmp_path / "x.npz"
    )
    out = tmp_path / "bundled.npz"
    back = tmp_path / "bundled.csv"
    assert stga("drive", files["take.csv"], "--out", out) == 0
    assert read_motion(out, flame_model(None)).frame(9).eyes_pose[1] > 0.5
    assert stga("drive", out, "--out", back) == 0
    given = read_performance(files["take.csv"])
    found = read_performance(back)
    assert_allclose(found.weights, given.weights, atol=1e-6)
    assert_allclose(found.head, given.head, atol=1e-5)


def test_render_and_export_a_performance(files, tmp_path, capsys):
    """Catches a command that takes FLAME motions alone, or options that change nothing."""
    motion = f"--motion {files['take.csv']} --flame {files['flame.npz']}"
    base = f"render {files['a.npz']} --cameras {files['cameras.json']} {motion}"
    base += " --gain head=0 --device cpu --out"
    assert stga(base, tmp_path / "full") == 0
    assert stga(base, tmp_path / "less", "--gain", "jaw=0.2") == 0
    full, less = (
        [np.asarray(Image.open(path)).astype(int) for path in sorted((tmp_path / name).iterdir())]
        for name in ("full", "less")
    )
    assert len(full) == len(less) == 10
    assert np.abs(full[0] - less[0]).max() <= 1
    assert np.abs(full[9] - full[0]).sum() > 2 * np.abs(less[9] - less[0]).sum() > 0
    ply = f"export {files['a.npz']} --format ply"
    assert stga(ply, "--timestep 9", motion, "--out", tmp_path / "a.ply") == 0
    assert (tmp_path / "a.ply").stat().st_size > 1000
    assert "is no run with a FLAME capture" in refused(
        capsys, base, tmp_path / "x", "--stay-trained"
    )
    assert "--mirror: has no effect without --motion" in refused(
        capsys, ply, "--mirror", "--out", tmp_path / "b.ply"
    )


def write_moving_capture(root, model):
    """A FLAME capture whose head turns, and speaks, at random."""
    write_flame_capture(root)
    rng = np.random.default_rng(0)
    for path in [*(root / "flame_param").iterdir(), root / "canonical_flame_param.npz"]:
        sizes = {"expr": model.n_expression, "rotation": 3, "jaw_pose": 3, "neck_pose": 3}
        values = {name: rng.normal(0, 0.1, (1, size)) for name, size in sizes.items()}
        other = {"shape": np.zeros(model.n_identity), "translation": rng.normal(0, 0.1, (1, 3))}
        np.savez(path, **values, **other)


@pytest.mark.parametrize("misfit", [0.1, 0.8])
def test_a_performers_avatar_tracks_a_video(files, tmp_path, monkeypatch, misfit):
    """Catches another motion, rate or head than tracked, a stranger's avatar, what a cancelled
    request left of another avatar or another day's video, and folders left."""
    root = tmp_path / "capture"
    run = tmp_path / "run"
    video = tmp_path / "face.mp4"
    steps = []
    model = small_head(0)
    write_moving_capture(root, model)
    run.mkdir()
    write_run(run, Run(root, files["flame.npz"], "vhap", TrainingSettings(iterations=1)))
    (run / AVATAR).touch()
    monday = tmp_path / "monday.mp4"
    for path, shade in ((video, 100), (monday, 50)):
        with video_writer(path, 25) as append:
            for _ in range(20):
                append(np.full((64, 64, 3), shade, np.uint8))

    def tracked(request, report, log):
        steps.append(request.step)
        leave(request.out, request.footage, request.step, misfit, avatar_version(run))

    def leave(folder, source, step, misfit, version):
        shutil.copytree(root, folder, dirs_exist_ok=True)
        footage = open_footage(source, frames=FrameRange(step=step))
        write_json(folder / FOOTAGE_FILE, {**footage_state(footage), "landmarks": None})
        found = {"avatar": version, "image_misfit": {AVATAR_MISFIT: {"0": misfit}}}
        write_json(folder / REPORT_FILE, found)

    def watched(path, report):
        return Performance(np.arange(2) / 25, np.full((2, 52), 0.5), np.zeros((2, 3)), 25)

    monkeypatch.setattr("stga_addon.jobs.convert_motion.track", tracked)
    monkeypatch.setattr("stga_addon.driving.face_video.watched_performance", watched)
    drive = f"drive {video} --avatar {run} --out"
    # left by cancelled ones: of another avatar, another video, and of the same
    leave(tmp_path / "a.npz.check", video, 2, 1 - misfit, [])
    leave(tmp_path / "a.npz.tracking", monday, 1, misfit, avatar_version(run))
    leave(tmp_path / "a.csv.check", monday, 2, 1 - misfit, avatar_version(run))
    leave(tmp_path / "b.csv.check", video, 2, misfit, avatar_version(run))
    assert stga(drive, tmp_path / "a.npz", "--fps", 2 * DEFAULT_FPS) == 0
    assert stga(drive, tmp_path / "a.csv") == 0
    assert stga(drive, tmp_path / "b.csv") == 0
    motion = read_motion(tmp_path / "a.npz", model)
    head = read_performance(tmp_path / "a.csv").head
    assert not [*tmp_path.glob("*.tracking"), *tmp_path.glob("*.check")]
    if misfit > MAX_MISFIT:
        assert steps == [2, 2]  # and none for the last
        assert not head.any()  # does not turn
        return
    assert steps == [2, 1, 2, 1, 1]
    own = open_capture(root, files["flame.npz"]).flame
    frames = [own.frame(timestep) for timestep in own.timesteps]
    for timestep, frame in zip(own.timesteps, frames, strict=True):
        found = motion.frame(2 * timestep).parameters
        assert_allclose(found, frame.parameters, atol=1e-6)
    root_joint, neck = (Rotation.from_rotvec([f.pose[joint] for f in frames]) for joint in (0, 1))
    turned = root_joint * neck
    expected = (turned * turned[0].inv()).as_euler("YXZ")
    assert_allclose(head[np.array(own.timesteps)], expected, atol=1e-4)
