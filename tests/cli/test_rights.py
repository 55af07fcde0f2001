"""Commands about what may not be read, and links to themselves."""

import shutil

import pytest
from capture.factory import write_flame_capture
from command_line import refused
from rights import as_a_user

COMMANDS = {
    "info {capture}": "capture",
    "presets {capture}": "capture",
    "select {capture}": "capture",
    "train {capture} --iterations 1 --out {new}": "capture",
    "train {capture} --iterations 1 --out {run} --resume": "run",
    "train {flame} --flame {model} --iterations 1 --out {new}": "model",
    "refine {run} --region mouth --iterations 1 --out {new}": "run",
    "extend {run} {capture} --iterations 1 --out {new}": "run",
    "relight {run}": "run",
    "eval {run}": "run",
    "render {run} --turntable --out {new}": "run",
    "render {avatar} --cameras {cameras} --capture {capture} --out {new}": "avatar",
    "render {avatar} --cameras {cameras} --capture {capture} --out {new}/a": "cameras",
    "export {run} --format ply --out {new}.ply": "run",
    "export {avatar} --format ply --out {new}.ply": "avatar",
    "drive {flame} --flame {model} --out {new}.csv": "flame",
    "drive {take} --out {new}.npz": "take",
    "track {footage} --out {new}": "footage",
    "avatar {footage} --iterations 1 --out {new}": "footage",
    "batch {plan}": "plan",
    "batch {capture} --iterations 1 --out {new}": "capture",
    "perform {job}": "job",
}
"""Command -> which of its inputs may not be read."""


@pytest.fixture(scope="module")
def inputs(root, trained, tmp_path_factory):
    """Each in a folder of its own."""
    base = tmp_path_factory.mktemp("inputs")
    found = {name: base / name / "it" for name in ("capture", "run", "flame", "footage", "job")}
    files = {"model": "npz", "avatar": "npz", "cameras": "json", "take": "csv", "plan": "toml"}
    found |= {name: base / name / f"it.{suffix}" for name, suffix in files.items()}
    for path in found.values():
        path.parent.mkdir()
    shutil.copytree(root, found["capture"])
    shutil.copytree(trained, found["run"])
    shutil.copytree(root / "images", found["footage"])
    _, model = write_flame_capture(found["flame"])
    shutil.move(model, found["model"])
    shutil.copy(trained / "avatar.npz", found["avatar"])
    shutil.copy(root / "transforms_val.json", found["cameras"])
    found["take"].write_text("Timecode,BlendShapeCount,JawOpen\n")
    found["plan"].write_text("")
    found["job"].mkdir()
    (found["job"] / "request.json").write_text("{}")
    return found


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("place", ["beside", "itself"])
def test_what_may_not_be_read_is_said(inputs, tmp_path, capsys, command, place):
    """Catches the traceback of a folder that may not be entered, which root never sees, and what
    may not be read called missing."""
    locked = inputs[COMMANDS[command]]
    words = command.format(**inputs, new=tmp_path / "new").split()
    shut = locked.parent if place == "beside" else locked
    mode = shut.stat().st_mode
    shut.chmod(0)
    try:
        with as_a_user():
            sentence = refused(capsys, *words)
    finally:
        shut.chmod(mode)
    assert "Permission denied" in sentence
    assert str(locked) in sentence
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("command", "name"),
    [*COMMANDS.items(), *((command, "new") for command in COMMANDS if command.endswith("{new}"))],
)
def test_a_link_to_itself(inputs, tmp_path, capsys, command, name):
    """Catches the RuntimeError by which pathlib says so, and what is written over the link."""
    loop = (tmp_path / "loop").with_suffix(inputs.get(name, tmp_path).suffix)
    loop.symlink_to(loop)
    words = command.format(**{**inputs, "new": tmp_path / "new", name: loop}).split()
    assert str(loop) in refused(capsys, *words)
    assert loop.is_symlink()
    assert set(tmp_path.iterdir()) == {loop}
