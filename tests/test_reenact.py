"""`stga render --motion`: an avatar moved by another person, without Blender."""

import numpy as np
import pytest
from capture import factory
from command_line import stga
from PIL import Image

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.render.render import render_avatar, to_uint8

RENDER = "render {avatar} --cameras {cameras} --motion {motion} --out"


@pytest.fixture
def parts(tmp_path):
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


def render(parts, out, *more):
    return stga(RENDER.format(**parts), out, *more)


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
    arrays = np.load(parts["motion"])
    pose = arrays["pose"][1]
    frame = FlameFrame(arrays["expr"][1], pose[:3], pose[3:6], pose[6:9], np.zeros(3), pose[9:])
    mesh = flame_forward(own.model, own.shape, frame, own.static_offset)
    expected = to_uint8(
        render_avatar(read_avatar(parts["avatar"]), mesh, view.camera, (1.0, 1.0, 1.0))
    )
    first, drawn = (np.asarray(Image.open(out / f"0000{t}_01.png")).astype(int) for t in (0, 1))
    assert np.abs(drawn - expected).max() <= 1
    assert np.abs(drawn - first).max() > 50


@pytest.mark.parametrize("more", ["--video {out}.mp4", "--turntable 90 --seconds 1 --out {out}"])
def test_the_cameras_of_the_capture(parts, tmp_path, more):
    """Catches a film of a motion that asks for cameras, though the capture has some."""
    words = "render {avatar} --capture {capture} --motion {motion} --flame {model} " + more
    assert stga(words.format(**parts, out=tmp_path / "film")) == 0
    assert any(tmp_path.glob("film*"))
