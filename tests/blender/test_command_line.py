"""`blender --background head.blend --command stga …`: commands about the head of the open file."""

import sys
from importlib import import_module

import bpy
import numpy as np
import pytest
from capture.factory import write_mesh_capture
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.export.ply import read_ply
from stga_addon.scene.vertex_groups import read_selection

from .captures import mesh_at
from .session import import_flame, open_file, ops, panel, save
from .test_operators import show_ball


@pytest.fixture
def stga(extension):
    """Run a command as Blender hands it over; returns the exit code."""
    return lambda *arguments: extension.operators.command_line._run(
        [str(argument) for argument in arguments]
    )


def save_and_open(path):
    save(path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    open_file(path)


def test_the_open_head_stands_in_for_the_capture(stga, tmp_path, capfd):
    """Catches a parser that asks for less than it needs, and a command on another head."""
    with pytest.raises(SystemExit, match="2"):
        stga("info")
    assert "CAPTURE" in capfd.readouterr().err
    folder = write_mesh_capture(tmp_path / "capture")
    ops.import_capture(directory=folder)
    save_and_open(tmp_path / "head.blend")
    assert stga("select", "--threshold", 0.0005) == 0
    assert "320 triangles" in capfd.readouterr().out
    assert stga("info", write_mesh_capture(tmp_path / "other", timesteps=(0, 5))) == 0
    assert "other" in capfd.readouterr().out
    assert stga("info") == 0
    assert "other" not in capfd.readouterr().out
    folder.rename(tmp_path / "elsewhere")
    assert stga("select") == 2
    assert "is not a folder" in capfd.readouterr().err


@pytest.fixture
def here(extension):
    """Run a command in this process, on the head of the open file; returns the exit code."""
    command = import_module(f"{extension.__name__}.stga_addon.cli.main")
    head = extension.operators.command_line._open_head
    return lambda *arguments: command.main([str(argument) for argument in arguments], head())


@pytest.mark.slow
def test_what_the_open_head_plays(stga, here, tmp_path):
    """Catches an export or rendering that misses avatar or capture, or has the tracked motion where
    the head in the file is animated otherwise."""
    folder, model = import_flame(tmp_path / "capture")
    avatar = show_ball(tmp_path / "a.npz", open_capture(folder, model).neutral, order=0)
    keys = panel().head.data.shape_keys
    keys.animation_data.action = None
    keys.key_blocks["expr_001"].value = 2.5
    save_and_open(tmp_path / "head.blend")
    assert stga("export", "--format", "ply-sequence", "--out", tmp_path / "plys") == 0
    pair = ("--format", "gaussian-avatars", "--out", tmp_path / "pair")
    assert stga("export", tmp_path / "a.npz", *pair) == 0
    written = sorted(path.name for path in (tmp_path / "plys").glob("*.ply"))
    assert written == [f"{timestep:05d}.ply" for timestep in range(4)]
    frames = avatar.frames(mesh_at(2))  # not among the tracked timesteps
    expected = to_world(avatar.splats, frames).xyz
    assert_allclose(read_ply(tmp_path / "plys/00002.ply").xyz, expected, atol=1e-6)
    with np.load(tmp_path / "pair/flame_param.npz") as pair:
        assert_allclose(pair["expr"][:, 1], 2.5)
        assert len(pair["expr"]) == 4
    cameras = ("--cameras", folder / "transforms_val.json", "--out")
    assert here("render", *cameras, tmp_path / "here") == 0
    assert stga("render", *cameras, tmp_path / "there") == 0
    given = (tmp_path / "a.npz", "--capture", folder, "--flame", model)
    assert stga("render", *given, *cameras, tmp_path / "tracked") == 0
    pictures, there, tracked = (
        [path.read_bytes() for path in sorted((tmp_path / name).glob("*.png"))]
        for name in ("here", "there", "tracked")
    )
    assert len(pictures) == 2
    assert pictures == there
    assert pictures != tracked


def test_missing_training_python(stga, extension, head, tmp_path, monkeypatch, capsys):
    """Catches a traceback, or success, where nothing can train."""
    monkeypatch.setattr(
        extension.stga_addon.worker.training_python, "missing_packages", lambda: ["torch"]
    )
    assert stga("train", tmp_path / "capture", "--out", tmp_path / "run") == 2
    expected = "Install the complete edition of the add-on, or choose a Python"
    assert expected in capsys.readouterr().err
    assert stga("select") == 0  # needs none


@pytest.mark.parametrize("command", ["train", "track", "avatar"])
def test_the_chosen_python_carries_commands_out(stga, extension, tmp_path, monkeypatch, command):
    """Catches a command in Blender's Python, or a farm's, although another was chosen."""
    chosen = tmp_path / "python"
    chosen.write_text(f'#!/bin/sh\necho "$@" > "{tmp_path}/asked"\nexit 7\n')
    chosen.chmod(0o755)
    monkeypatch.setenv(extension.stga_addon.worker.training_python.PYTHON_VARIABLE, str(chosen))
    given = extension.operators.training_python.training_python(bpy.context, "/given/python")
    assert given == "/given/python"
    model = [] if command == "train" else ["--model", "HEAD"]
    more = ["--iterations", "2"] if command != "track" else []
    arguments = [command, "FOOTAGE", *model, "--out", "OUT", *more]
    assert stga(*arguments) == 7
    expected = ["-m", "stga_addon", *arguments, *(["--no-blend"] if command == "avatar" else [])]
    assert (tmp_path / "asked").read_text().split() == expected


@pytest.mark.slow
def test_training_is_the_panels(stga, here, head, tmp_path):
    """Catches a headless run or worker that ignores painted groups or settings."""
    pytest.importorskip("torch")
    ops.select(threshold=0.0005)
    head.vertex_groups["stga_3"].remove(list(range(60)))
    head.vertex_groups.new(name="stga_0").add(list(range(40)), 1.0, "REPLACE")
    painted = read_selection(head)
    save_and_open(tmp_path / "head.blend")
    options = {"iterations": 8, "strategy": "selective", "seed": 3, "device": "cpu"}
    by_worker = {"wait": True, "python": sys.executable, "effects": "relight=off"}
    ops.train(directory=tmp_path / "panel", **by_worker, **options)
    arguments = [item for name, value in options.items() for item in (f"--{name}", value)]
    arguments += ["--effect", "relight=off"]
    assert here("train", "--out", tmp_path / "headless", *arguments) == 0
    assert stga("train", "--out", tmp_path / "delegated", *arguments) == 0
    runs = ("panel", "headless", "delegated")
    for run in runs:
        with np.load(tmp_path / run / "selection.npz") as stored:
            for timestep, faces in painted.items():
                assert_array_equal(stored[f"{timestep:05d}"], faces)
    one, *others = (read_avatar(tmp_path / run / "avatar.npz").splats for run in runs)
    for other in others:
        for name in ("xyz", "rotation", "log_scale", "opacity", "sh", "face"):
            assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.slow
def test_an_avatar_from_footage(stga, take, tmp_path, capfd):
    """Catches a missing .blend file where the training Python has no Blender, or no links."""
    given = [take / "footage", "--model", take / "head.npz", "--landmarks", take / "points"]
    more = ["--iterations", "4", "--effect", "tracking=on", "--effect", "relight=off"]
    assert stga("avatar", *given, "--out", tmp_path / "out", *more) == 0
    assert capfd.readouterr().out.splitlines()[-1] == f"blender: {tmp_path / 'out/avatar.blend'}"
    open_file(tmp_path / "out/avatar.blend")
    (head,) = [thing for thing in bpy.data.objects if thing.get("stga_kind") == "head"]
    assert head["stga_avatar"] == str(tmp_path / "out/run/avatar.npz")
    assert any("tracking" in action.name for action in bpy.data.actions)  # the refined motion
