"""`stga avatar` from footage to a .blend file, interrupted and continued."""

import re
from contextlib import redirect_stdout
from io import StringIO

import pytest
from command_line import refused, stga

from stga_addon.capture.open import open_capture
from stga_addon.cli import commands
from stga_addon.files import write_json
from stga_addon.tracking import write_capture
from stga_addon.tracking.torso import FollowedTorso


def make(take, out, *more):
    files = f"{take}/footage --model {take}/head.npz --landmarks {take}/points --out {out}"
    quick = "--mattes none --iterations 6 --effect relight=off --effect tracking=off"
    return stga("avatar", files, quick, *more)


@pytest.fixture(scope="module")
def made(take, tmp_path_factory):
    """An avatar made in two calls, the first interrupted as the capture was written."""
    pytest.importorskip("bpy", reason="bpy is not installed")
    out = tmp_path_factory.mktemp("made") / "out"

    def interrupt(path, value):
        if path.name == "transforms_train.json":
            raise KeyboardInterrupt
        write_json(path, value)

    printed = StringIO()
    with pytest.MonkeyPatch.context() as patch:
        # What takes the longest, and tests of tracking look at
        patch.setattr("stga_addon.tracking.fitted_head.fit_dense", lambda *_, **__: None)
        patch.setattr(
            "stga_addon.tracking.fitted_head.fit_surface", lambda head, fit, *_, **__: fit
        )
        follow = lambda fit, own, *_: FollowedTorso(fit, own)  # noqa: E731
        patch.setattr("stga_addon.tracking.fitted_head.follow_torso", follow)
        with patch.context() as first:
            first.setattr(write_capture, "write_json", interrupt)
            assert make(take, out) == 130
        assert not (out / "run").exists()
        with redirect_stdout(printed):
            assert make(take, out) == 0
    return out, printed.getvalue().splitlines()


def test_a_finished_avatar(made, take):
    """Catches a summary without a step, links of the .blend file that lead nowhere, and a second
    call that tracks or trains anew."""
    out, lines = made
    summary = lines[lines.index("") + 1 :]
    begins = "footage: cameras 5, timesteps 5", "tracking: ", "report: ", "avatar: ", "blender: "
    for begin in (*begins, "time: "):
        assert sum(line.startswith(begin) for line in summary) == 1, begin
    assert "interpolated: 2" in summary[0]
    import bpy

    assert open_capture(out / "capture", take / "head.npz").timesteps == (0, 1, 2, 3, 4)
    bpy.ops.wm.open_mainfile(filepath=str(out / "avatar.blend"))
    (head,) = [thing for thing in bpy.data.objects if thing.get("stga_kind") == "head"]
    (splats,) = [thing for thing in bpy.data.objects if thing.get("stga_kind") == "splats"]
    assert list(head["stga_timesteps"]) == [0, 1, 2, 3, 4]
    assert head["stga_capture"] == str(out / "capture")
    assert head["stga_avatar"] == str(out / "run/avatar.npz")
    assert len(splats.data.vertices) > 100
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


def test_a_wrong_folder_is_left_as_it_is(take, tmp_path, capsys):
    """Catches a folder that remembers a mistake, and somebody's run taken for a part of it."""
    words = f"avatar {tmp_path}/nowhere --model {take}/head.npz --out {tmp_path}/out"
    assert "nowhere: does not exist" in refused(capsys, words)
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    assert stga(words) == 2
    assert list((tmp_path / "out").iterdir()) == []
    (tmp_path / "out/run").mkdir()
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
