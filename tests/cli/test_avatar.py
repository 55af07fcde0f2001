"""`stga avatar` from footage to a .blend file, interrupted and continued."""

import re
from contextlib import redirect_stdout
from io import StringIO

import pytest
from command_line import stga

from stga_addon.capture.open import open_capture
from stga_addon.cli import commands
from stga_addon.cli.main import main
from stga_addon.files import read_json, write_json
from stga_addon.tracking import write_capture
from stga_addon.tracking.torso import FollowedTorso


def make(take, out, *more):
    arguments = [
        "--model", str(take / "head.npz"), "--out", str(out), "--landmarks", str(take / "points"),
    ]  # fmt: skip
    return stga("avatar", take / "footage", *arguments, "--iterations 6", *more)


@pytest.fixture(scope="module")
def made(take, tmp_path_factory):
    """An avatar made in two calls, of which the first was interrupted as the capture was written;
    and what it said."""
    pytest.importorskip("bpy", reason="bpy is not installed")
    out = tmp_path_factory.mktemp("made") / "out"

    def interrupt(path, value):
        if path.name == "transforms_train.json":
            raise KeyboardInterrupt
        write_json(path, value)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write_capture, "write_json", interrupt)
        # What takes the longest, and is thrown away here
        patch.setattr("stga_addon.tracking.track.fit_dense", lambda *_, **__: None)
        patch.setattr("stga_addon.tracking.track.fit_surface", lambda head, fit, *_, **__: fit)
        patch.setattr(
            "stga_addon.tracking.track.follow_torso", lambda fit, own, *_: FollowedTorso(fit, own)
        )
        assert make(take, out) == 130
    assert not (out / "run").exists()
    printed = StringIO()
    with redirect_stdout(printed):
        assert make(take, out) == 0
    return out, printed.getvalue().splitlines()


def test_one_summary_at_the_end(made):
    """Catches a step that is not reported, or reported twice."""
    _, lines = made
    summary = lines[lines.index("") + 1 :]
    begins = "footage: cameras 5, timesteps 5", "tracking: ", "report: ", "avatar: ", "blender: "
    for begin in (*begins, "time: "):
        assert sum(line.startswith(begin) for line in summary) == 1, begin
    assert "interpolated: 2" in summary[0]


def test_the_blend_file_shows_the_avatar_on_the_head(made, take):
    """Catches a file whose links lead nowhere once it is opened."""
    import bpy

    out, _ = made
    assert open_capture(out / "capture", take / "head.npz").timesteps == (0, 1, 2, 3, 4)
    bpy.ops.wm.open_mainfile(filepath=str(out / "avatar.blend"))
    (head,) = [thing for thing in bpy.data.objects if thing.get("stga_kind") == "head"]
    (splats,) = [thing for thing in bpy.data.objects if thing.get("stga_kind") == "splats"]
    assert list(head["stga_timesteps"]) == [0, 1, 2, 3, 4]
    assert head["stga_capture"] == str(out / "capture")
    assert (out / splats["stga_avatar"].removeprefix("//")).is_file()
    assert len(splats.data.vertices) > 100


def test_a_finished_avatar_is_not_made_again(made, take):
    """Catches a second call that tracks or trains from the beginning, also of what a version made
    that noted less."""
    out, _ = made
    inputs = read_json(out / "inputs.json")
    for name in ("sync", "world", "meshes"):
        del inputs[name]
    write_json(out / "inputs.json", inputs)
    files = [out / "capture/transforms_train.json", out / "run/checkpoint.npz"]
    before = [path.stat().st_mtime_ns for path in files]
    assert make(take, out, "--no-blend") == 0
    assert [path.stat().st_mtime_ns for path in files] == before


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--start", "1"], "start: .*out began with 0; give another --out"),
        (["--offset", "cam1=2"], "offset: .*out began with"),
        (["--sync", "motion"], "sync: .*out began with 'none'"),
        (["--world", "keep"], "world: .*out began with 'auto'"),
        (["--meshes"], "meshes: .*out began with False"),
        (["--iterations", "9"], "--iterations: this run began with 6, which cannot change"),
    ],
)
def test_other_inputs_are_refused(made, take, capsys, more, expected):
    """Catches an avatar of one take that is continued with another."""
    assert make(take, made[0], "--no-blend", *more) == 2
    assert re.search(expected, capsys.readouterr().err)


def test_a_mistyped_footage_leaves_nothing_behind(take, tmp_path, capsys):
    """Catches a folder that remembers the mistake, and refuses the mended command as one of other
    inputs."""
    mistyped = [
        "avatar", str(tmp_path / "nowhere"), "--model", str(take / "head.npz"), "--out",
        str(tmp_path / "out"),
    ]  # fmt: skip
    assert main(mistyped) == 2
    assert "nowhere: is neither a folder nor a video" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    assert main(mistyped) == 2
    assert list((tmp_path / "out").iterdir()) == []


def test_a_folder_of_something_else_is_left_alone(take, tmp_path, capsys):
    """Catches a run or capture of the user's that is taken for a part of this avatar."""
    (tmp_path / "out/run").mkdir(parents=True)
    assert make(take, tmp_path / "out") == 2
    said = "holds something else (inputs.json is missing); give another --out"
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out/capture").exists()


def test_a_python_without_blender_says_so(take, tmp_path, monkeypatch, capsys):
    """Catches a command that fails at its very end, where the training Python has no bpy."""
    monkeypatch.setattr(commands, "find_spec", lambda name: None)
    monkeypatch.setattr(commands, "carry_out", lambda request: None)
    assert make(take, tmp_path / "out") == 0
    assert "this Python has no bpy" in capsys.readouterr().out
