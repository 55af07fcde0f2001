"""`stga render --motion`: an avatar moved by another person, without Blender."""

from pathlib import Path

import numpy as np
import pytest
from capture import factory
from PIL import Image

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.cli.main import main
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.render.render import render_avatar, to_uint8


@pytest.fixture
def parts(tmp_path: Path) -> dict[str, Path]:
    """A capture's model, an avatar of its identity, another's motion of two frames, cameras."""
    folder, model = factory.write_flame_capture(tmp_path / "capture")
    capture = open_capture(folder, model)
    factory.write_avatar_of(capture, tmp_path / "a.npz", is_colored=True)
    rng = np.random.default_rng(1)
    pose = rng.normal(0, 0.3, (2, 15))
    expr = rng.normal(size=(2, 2))
    np.savez(tmp_path / "other.npz", expr=expr, pose=pose, shape=np.full(4, 2.0))
    return {
        "avatar": tmp_path / "a.npz",
        "model": model,
        "motion": tmp_path / "other.npz",
        "cameras": folder / "transforms_train.json",
        "capture": folder,
    }


def render(parts: dict[str, Path], out: Path, *more: object) -> int:
    arguments = [
        "render",
        parts["avatar"],
        "--cameras",
        parts["cameras"],
        "--motion",
        parts["motion"],
        "--out",
        out,
    ]
    return main([str(a) for a in [*arguments, *more]])


def test_the_other_person_moves_the_avatar(parts, tmp_path):
    """Catches the other's identity, a wrong timestep, and cameras that come more than once."""
    out = tmp_path / "out"
    assert render(parts, out, "--flame", parts["model"]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        f"{t:05d}_{c:02d}.png" for t in (0, 1) for c in (0, 1)
    ]
    capture = open_capture(parts["capture"], parts["model"])
    own = capture.flame
    view = next(view for view in capture.views["train"] if view.camera_index == 1)
    assert own is not None
    arrays = np.load(parts["motion"])
    pose = arrays["pose"][1]
    frame = FlameFrame(arrays["expr"][1], pose[:3], pose[3:6], pose[6:9], np.zeros(3), pose[9:])
    mesh = flame_forward(own.model, own.shape, frame, own.static_offset)
    expected = to_uint8(
        render_avatar(read_avatar(parts["avatar"]), mesh, view.camera, (1.0, 1.0, 1.0))
    )
    with Image.open(out / "00001_01.png") as image:
        drawn = np.asarray(image)
    assert np.abs(drawn.astype(int) - expected.astype(int)).max() <= 1
    assert (
        np.abs(drawn.astype(int) - np.asarray(Image.open(out / "00000_01.png")).astype(int)).max()
        > 50
    )


def test_mistakes(parts, tmp_path, capsys):
    """Catches tracebacks for what a person gets wrong first."""
    assert render(parts, tmp_path / "out") == 2
    assert "give the FLAME model file" in capsys.readouterr().err
    meshes = factory.write_mesh_capture(tmp_path / "meshes")
    assert render(parts | {"motion": meshes}, tmp_path / "out", "--flame", parts["model"]) == 2
    assert "was not tracked with FLAME" in capsys.readouterr().err
    (tmp_path / "scan.ply").write_bytes(b"ply\n")
    scan = parts | {"avatar": tmp_path / "scan.ply"}
    assert render(scan, tmp_path / "out", "--flame", parts["model"]) == 2
    assert "scan.ply: holds splats in the world" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
