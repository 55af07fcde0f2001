"""`stga export --format web`: which frames, cameras and selection go into the page."""

from pathlib import Path

import pytest
from capture.factory import edit, write_avatar_of, write_flame_capture, write_mesh_capture
from command_line import stga
from export.web.web_data import read_web_data

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.cli.main import main


@pytest.fixture
def avatar_file(tmp_path: Path) -> Path:
    """An avatar of the mesh capture in the folder `capture` beside it."""
    capture = open_capture(write_mesh_capture(tmp_path / "capture"))
    return write_avatar_of(capture, tmp_path / "anna.npz", order=2, sh_degree=1)


def test_frames_cameras_and_selection_of_a_capture(avatar_file, tmp_path):
    """Catches frames outside the range, cameras that are missing, and a rate that is not the one
    asked for."""
    capture = open_capture(tmp_path / "capture")
    first, last = capture.timesteps[1], capture.timesteps[-1]
    words = ["--capture", str(capture.root), "--frames", f"{first}:{last}", "--fps", "30"]
    assert stga("export", avatar_file, "--format web", *words, "--out", tmp_path / "a.stga") == 0
    header, arrays = read_web_data((tmp_path / "a.stga").read_bytes())
    frames = len(capture.timesteps) - 1
    assert (header["title"], header["fps"]) == ("anna", 30)
    assert len(arrays["pose"]) == len(arrays["selection"]) == frames
    cameras = {view.camera_index for views in capture.views.values() for view in views}
    assert {view["name"] for view in header["views"]} == {f"Camera {index}" for index in cameras}


def test_the_captures_own_rate(avatar_file, tmp_path):
    """Catches footage of 60 frames a second that plays 2.4 times too slowly."""
    edit(tmp_path / "capture/transforms_train.json", lambda document: document.update(fps=60))
    words = ["--capture", str(tmp_path / "capture"), "--out"]
    assert stga("export", avatar_file, "--format web", *words, tmp_path / "a.stga") == 0
    assert read_web_data((tmp_path / "a.stga").read_bytes())[0]["fps"] == 60
    usd = pytest.importorskip("pxr.Usd", reason="the package usd-core is not installed")
    assert stga("export", avatar_file, "--format usd", *words, tmp_path / "a.usdc") == 0
    assert usd.Stage.Open(str(tmp_path / "a.usdc")).GetTimeCodesPerSecond() == 60


def test_a_run_brings_its_capture(tmp_path):
    """Catches a run whose page lacks the motion, cameras or selection that it was trained with."""
    capture = open_capture(write_mesh_capture(tmp_path / "capture"))
    run = tmp_path / "anna"
    assert stga("train", capture.root, "--out", run, "--iterations 2 --schedule paper") == 0
    assert main(["export", str(run), "--format", "web", "--out", str(tmp_path / "a.stga")]) == 0
    header, arrays = read_web_data((tmp_path / "a.stga").read_bytes())
    assert header["title"] == "anna"
    views = [view for split in capture.views.values() for view in split]
    assert len(header["views"]) == len({view.camera_index for view in views})
    assert len(arrays["pose"]) == len(arrays["selection"]) == len(capture.timesteps)
    assert len(arrays["xyz"]) == len(read_avatar(run / "avatar.npz").splats)


def test_an_avatar_alone_is_a_still(avatar_file, tmp_path):
    """Catches a page that cannot be made without a capture."""
    assert stga("export", avatar_file, "--format web --out", tmp_path / "a.html") == 0
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<title>anna</title>" in text
    assert "{{" not in text.partition('<script type="module">')[0]


def test_what_is_left_of_flame_is_said(tmp_path, capsys):
    """Catches an export without FLAME's rig that does not say that its triangles and meshes are in
    the page."""
    root, model = write_flame_capture(tmp_path / "flame")
    avatar = write_avatar_of(open_capture(root, model), tmp_path / "anna.npz", sh_degree=1)
    words = "export", avatar, "--format web --capture", root, "--flame", model
    assert stga(*words, "--motion-only --out", tmp_path / "a.stga") == 0
    said = "Contains the triangles and the posed meshes of a FLAME head: FLAME's licence"
    assert said in capsys.readouterr().out
    assert stga(*words, "--out", tmp_path / "a.stga") == 0
    said = "--motion-only leaves them out, but not the meshes of the take."
    assert said in capsys.readouterr().out
