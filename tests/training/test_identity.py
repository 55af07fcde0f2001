"""What was trained on one capture is not continued, measured or rendered on another."""

import json
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
from capture import factory
from command_line import stga
from PIL import Image
from refusal import refusal

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.jobs.perform import request_folder, write_request
from stga_addon.jobs.train import Resume
from stga_addon.raster import devices as device_choice
from stga_addon.training.run import folder as open_run_module
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.folder import device_of, open_run, read_run, write_run
from stga_addon.training.run.identity import difference, identity_of
from stga_addon.training.run.session import train_run

from .toys import assert_same_run, iteration_of, quick_settings, run_of, stop_at

ITERATIONS = 12


def make_run(capture, flame=None, **changes):
    typical = {"iterations": ITERATIONS, "lattice": 0, "sh_degree": 0}
    typical["driven_offsets"] = ("strain_color",)
    return replace(run_of(capture, **{**typical, **changes}), flame=flame)


@pytest.fixture(scope="session")
def begun(toy, tmp_path_factory):
    """A run of the toy capture, stopped halfway."""
    out = tmp_path_factory.mktemp("begun") / "run"
    train_run(toy, out, make_run(toy), report=stop_at(ITERATIONS // 2))
    return out


@pytest.fixture
def copy(begun, tmp_path):
    """A copy of that run, to be damaged."""
    return shutil.copytree(begun, tmp_path / "run")


def edit_frames(root, change):
    for path in root.glob("transforms_*.json"):
        factory.edit(path, lambda document: [change(frame) for frame in document["frames"]])


def move_cameras(root):
    def change(frame):
        frame["transform_matrix"][0][3] += 0.001

    edit_frames(root, change)


def rename_images(root):
    shutil.copytree(root / "images", root / "pictures")
    edit_frames(
        root, lambda frame: frame.update(file_path=frame["file_path"].replace("images", "pictures"))
    )


def halve_images(root):
    for path in (*root.glob("images/*"), *root.glob("fg_masks/*")):
        Image.open(path).resize((20, 30)).save(path)
    edit_frames(root, lambda frame: frame.update(w=20, h=30))


def other_topology(root):
    vertices, faces = factory.ball()
    for path in (root / "meshes").iterdir():
        factory.write_mesh(path, vertices, faces[:, ::-1])


def larger_neutral(root):
    vertices, faces = factory.ball()
    factory.write_mesh(root / "meshes/neutral.obj", 1.15 * vertices, faces)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (move_cameras, "other camera poses or intrinsics"),
        (halve_images, "other images or image sizes"),
        (rename_images, "other images or image sizes"),
        (other_topology, "a mesh with other triangles"),
        (larger_neutral, "another neutral mesh"),
    ],
)
def test_changed_captures_are_refused(copy, toy, tmp_path, change, message):
    """Catches a run resumed or measured on another capture, named or replaced in place."""
    other = shutil.copytree(toy.root, tmp_path / "other")
    change(other)
    both = rf"was trained on {toy.root} \(4 cameras, 4 timesteps\), but {other} \(.*{message}"
    with refusal(both):
        open_run(copy, other)
    with refusal(message):
        train_run(open_capture(other), copy, make_run(toy), resume=True)
    # replaced in place
    factory.edit(copy / "run.json", lambda document: document.update(capture=str(other)))
    with refusal(rf"was trained on {other} .*, but it now has .*{message}"):
        open_run(copy)


def test_moved_captures_and_refined_meshes_are_accepted(copy, toy, tmp_path):
    """Catches a run lost with its capture's old path, or with a better tracking."""
    other = shutil.copytree(toy.root, tmp_path / "other")
    vertices, faces = factory.ball()
    for timestep in toy.timesteps:
        factory.write_mesh(other / f"meshes/{timestep:05d}.obj", vertices * 1.001, faces)
    opened = open_run(copy, other)
    assert opened.run.capture == opened.capture.root == other
    train_run(opened.capture, copy, opened.run, resume=True)
    assert read_checkpoint(copy).iteration == ITERATIONS
    assert read_run(copy).capture == other


def test_last_bits_of_another_machine_are_accepted(toy):
    """Catches a run lost where another linear algebra library rounds differently."""
    rng = np.random.default_rng(0)

    def shifted(view):
        noise = 1e-15 * rng.normal(size=(4, 4))
        return replace(
            view, camera=replace(view.camera, world_to_camera=view.camera.world_to_camera + noise)
        )

    views = {split: tuple(map(shifted, members)) for split, members in toy.views.items()}
    settings = quick_settings()
    same = replace(toy, views=views, neutral=toy.neutral + 1e-16)
    one, two = (identity_of(capture, "vhap", settings) for capture in (toy, same))
    assert one == two
    assert difference(one, two) is None


def test_runs_from_before_a_setting_can_be_resumed(copy):
    """Catches a new setting that makes all earlier runs ones with other settings."""
    file = copy / "run.json"
    values = json.loads(file.read_text())
    del values["settings"]["covered"]
    file.write_text(json.dumps(values))
    stored = read_run(copy)
    capture = open_capture(stored.capture)
    assert identity_of(capture, stored.principal_point, stored.settings) == stored.identity
    covered = replace(stored.settings, covered=((0, 1),))
    assert identity_of(capture, stored.principal_point, covered) != stored.identity


def test_another_flame_model_is_refused(toy, tmp_path):
    """Catches a run that goes on with the meshes of another FLAME model, though --flame may name a
    moved one, and one that blames the FLAME file where it is resumed on tracked meshes."""
    root, model = factory.write_flame_capture(tmp_path / "capture")
    capture = open_capture(root, model)
    out = tmp_path / "run"
    train_run(capture, out, make_run(capture, model), report=stop_at(4))
    moved = shutil.copy(model, tmp_path / "moved.npz")
    assert open_run(out, flame=moved).run.flame == moved
    other = factory.write_flame_model(tmp_path / "other.npz", seed=1)
    with refusal(f"was trained with FLAME model {model}, but {other} has other content"):
        open_run(out, flame=other)
    with refusal(rf"was trained on {root} .* but {toy.root} \(.* has "):
        open_run(out, toy.root)
    assert stga("train", root, "--out", out, "--resume --flame", other) == 2
    assert stga("train", root, "--out", out, "--resume --flame", moved) == 0


def test_every_command_checks_the_identity(copy, toy, tmp_path, capsys):
    """Catches a command without the check: each ends with one sentence and exit code 2."""
    other = shutil.copytree(toy.root, tmp_path / "other")
    move_cameras(other)
    before = {path.name: path.read_bytes() for path in copy.iterdir()}
    assert stga("train", other, "--out", copy, "--resume") == 2
    for request in (Resume(copy, toy.root, principal_point="opencv"), Resume(copy, other)):
        write_request(request_folder(copy), request)
        assert stga("perform", request_folder(copy)) == 2
    assert {path.name: path.read_bytes() for path in copy.iterdir() if path.is_file()} == before
    factory.edit(copy / "run.json", lambda document: document.update(capture=str(other)))
    cameras = other / "transforms_test.json"
    ply = tmp_path / "a.ply"
    assert stga("eval", copy) == 2
    assert stga("render", copy, "--cameras", cameras, "--out", tmp_path / "pictures") == 2
    assert stga("export", copy, "--format ply --out", ply) == 2
    told = capsys.readouterr().err
    assert told.count("other camera poses or intrinsics; train into another folder") == 5
    assert told.count("principal point 'vhap', not 'opencv'") == 1
    # Another capture that is named drives the avatar: only its triangles must fit.
    assert stga("export", copy, "--capture", other, "--format ply --timestep 0 --out", ply) == 0


def test_a_checkpoint_left_from_another_run_is_not_taken(copy, toy):
    """Catches a new run that continues a removed one, as it died before a checkpoint."""
    (copy / "run.json").unlink()
    run = make_run(toy, seed=5)

    def die(progress):
        if iteration_of(progress):
            raise OSError("died")
        return False

    with pytest.raises(OSError, match="died"):
        train_run(toy, copy, run, report=die)
    assert not (copy / "checkpoint.npz").exists()
    reached = []

    def report(progress):
        return bool(reached.append(iteration_of(progress)))

    train_run(toy, copy, run, resume=True, report=report)
    assert sorted(set(reached))[:2] == [0, 1]


@pytest.mark.parametrize("name", ["checkpoint.npz", "selection.npz", "strain_range.npz"])
def test_files_of_another_run_are_refused(copy, toy, tmp_path, name):
    """Catches a checkpoint, selection or range copied beside the run.json of another run."""
    train_run(toy, tmp_path / "other", make_run(toy, seed=5), report=stop_at(3))
    shutil.copy(tmp_path / "other" / name, copy / name)
    with refusal(rf"{name}: belongs to another run than run\.json"):
        train_run(toy, copy, make_run(toy), resume=True)


def test_principal_point_comes_with_run_and_avatar(toy, tmp_path):
    """Catches `render` that reads cameras by another convention than the avatar's."""
    root = shutil.copytree(toy.root, tmp_path / "capture")
    edit_frames(root, lambda frame: frame.update(cy=frame["cy"] + 7))
    capture = open_capture(root, principal_point="opencv")
    out = tmp_path / "run"
    train_run(capture, out, replace(make_run(capture), principal_point="opencv"))
    assert read_avatar(out / "avatar.npz").principal_point == "opencv"
    cameras = root / "transforms_test.json"

    def pictures(source, *options):
        folder = tmp_path / f"{source.name}{len(options)}"
        driver = ("--capture", root) if source.is_file() else ()
        assert stga("render", source, "--cameras", cameras, "--out", folder, *driver, *options) == 0
        return [path.read_bytes() for path in sorted(folder.iterdir())]

    expected = pictures(out, "--principal-point opencv")
    assert expected != pictures(out / "avatar.npz", "--principal-point vhap")
    assert pictures(out) == pictures(out / "avatar.npz") == expected


def test_device_belongs_to_the_run(copy, monkeypatch):
    """Catches a run that moves from the CPU to a GPU, or to another GPU."""
    run = read_run(copy)
    assert run.device == "cpu"
    card = {"cpu": "cpu", "gpu": "gpu:Card"}
    monkeypatch.setattr(open_run_module, "choose_device", lambda wanted: (card[wanted], "why"))
    assert device_of(run)[0] == "cpu"
    assert device_of(run, "gpu")[0] == "gpu:Card"
    monkeypatch.setattr(open_run_module, "adapter_names", lambda: ["Card", "Second Card"])
    monkeypatch.setattr(open_run_module, "choose_device", lambda wanted: (wanted, "why"))
    assert device_of(replace(run, device="gpu:Second Card"))[0] == "gpu:Second Card"
    assert device_of(replace(run, device="gpu:Card of another machine"))[0] == "gpu"
    with refusal("refines the tracking, which works on the CPU only"):
        device_of(replace(run, settings=replace(run.settings, tracking=True)), "gpu")
    monkeypatch.undo()
    monkeypatch.setattr(device_choice, "find_spec", lambda name: None)
    with refusal(r"trained on gpu: .*wgpu .* is not installed; give --device cpu"):
        device_of(replace(run, device="gpu:Card"))
    assert device_of(replace(run, device="cuda:0"), "cpu")[0] == "cpu"


def test_interrupt_saves_and_resumes_to_the_same_bits(toy, tmp_path):
    """Catches Ctrl-C that loses what was trained or half an iteration, or cannot quit at once."""

    def interrupt(progress):
        if iteration_of(progress) == 5 and progress.stage == "Training":
            signal.raise_signal(signal.SIGINT)
        return False

    out = tmp_path / "run"
    unbroken = tmp_path / "unbroken"
    with pytest.raises(KeyboardInterrupt):
        train_run(toy, out, make_run(toy), report=interrupt)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert read_checkpoint(out).iteration == 5
    assert len(read_avatar(out / "avatar.npz").splats) == len(toy.faces)
    train_run(toy, out, make_run(toy), resume=True)
    train_run(toy, unbroken, make_run(toy))
    assert_same_run(out, unbroken)

    def interrupt_twice(progress):
        if iteration_of(progress) == 5:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        return False

    with pytest.raises(KeyboardInterrupt):
        train_run(toy, tmp_path / "twice", make_run(toy), report=interrupt_twice)
    assert not (tmp_path / "twice/checkpoint.npz").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_prepared_run_begins_with_its_identity(toy, tmp_path):
    """Catches a run.json written ahead of the training that stays without identity."""
    write_run(tmp_path, make_run(toy))
    assert json.loads((tmp_path / "run.json").read_text())["identity"] is None
    train_run(toy, tmp_path, make_run(toy), resume=True, report=stop_at(2))
    stored = read_run(tmp_path)
    assert stored.identity == identity_of(toy, "vhap", stored.settings)
