"""`stga render --video` and `--turntable`."""

import av
import numpy as np
import pytest
from capture import factory
from command_line import stga
from PIL import Image

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.camera import orbited
from stga_addon.capture.open import open_capture
from stga_addon.cli.main import main
from stga_addon.export.ply import write_ply
from stga_addon.render.render import render_avatar, to_uint8

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture
def parts(tmp_path):
    """A capture and an avatar whose every splat has its own color."""
    root = factory.write_mesh_capture(tmp_path / "ball", (0, 1, 3), range(3))
    avatar = factory.write_avatar_of(open_capture(root), tmp_path / "a.npz", is_colored=True)
    return {"avatar": avatar, "capture": root}


def render(parts, *more):
    return main([str(a) for a in ("render", parts["avatar"], "--capture", parts["capture"], *more)])


def decoded(path):
    with av.open(str(path)) as container:
        rate = container.streams.video[0].average_rate
        assert rate is not None
        return float(rate), [
            frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)
        ]


def camera_of(capture, index):
    views = [view for split in capture.views.values() for view in split]
    return next(view.camera for view in views if view.camera_index == index)


def test_video_of_the_motion(parts, tmp_path):
    """Catches another camera, and timesteps missing, doubled, changed or out of order."""
    assert render(parts, "--video", tmp_path / "v.mp4", "--camera", 2, "--fps", 10) == 0
    rate, images = decoded(tmp_path / "v.mp4")
    assert (rate, len(images)) == (10, 3)
    avatar = read_avatar(parts["avatar"])
    capture = open_capture(parts["capture"])
    camera = camera_of(capture, 2)
    for image, timestep in zip(images, (0, 1, 3), strict=True):
        errors = {
            other: np.abs(
                to_uint8(render_avatar(avatar, capture.mesh(other), camera)).astype(int) - image
            ).mean()
            for other in capture.timesteps
        }
        assert min(errors, key=errors.__getitem__) == timestep
        assert errors[timestep] < 12  # colors at half the resolution: splats are a few pixels wide
    cameras = ["--cameras", parts["capture"] / "transforms_train.json"]
    names = {}
    for span in ("0:3", "0:0", "1-3"):
        assert render(parts, *cameras, "--out", tmp_path / span, "--frames", span) == 0
        names[span] = {path.name: path.read_bytes() for path in (tmp_path / span).glob("*.png")}
    assert names["0:0"]
    assert names["1-3"]
    assert names["0:0"].keys().isdisjoint(names["1-3"])
    assert {**names["0:0"], **names["1-3"]} == names["0:3"]
    assert render(parts, "--video", tmp_path / "w.mp4", "--frames", "1:3") == 0
    assert len(decoded(tmp_path / "w.mp4")[1]) == 2


def test_turntable_as_pictures(parts, tmp_path):
    """Catches a turn about another point or of a part of the circle, and stills."""
    out = tmp_path / "turn"
    options = "--seconds", 2, "--fps", 4, "--camera", 0
    assert render(parts, "--turntable", 360, "--out", out, *options) == 0
    pictures = sorted(out.glob("*.png"))
    assert [path.name for path in pictures] == [f"{index:04d}.png" for index in range(1, 9)]
    avatar = read_avatar(parts["avatar"])
    capture = open_capture(parts["capture"])
    start = camera_of(capture, 0)
    first = capture.mesh(0)
    center = (first.min(0) + first.max(0)) / 2
    for index, timestep in ((0, 0), (2, 3), (3, 1), (5, 1)):
        camera = orbited(start, center, (0, 1, 0), np.radians(45 * index))
        expected = to_uint8(render_avatar(avatar, capture.mesh(timestep), camera)).astype(int)
        assert np.abs(np.asarray(Image.open(pictures[index])) - expected).max() <= 1


def test_turntable_of_a_ply(parts, tmp_path):
    """Catches a PLY, which has neither timesteps nor capture, that cannot be turned."""
    ply = tmp_path / "scan.ply"
    cameras = parts["capture"] / "transforms_train.json"
    write_ply(ply, read_avatar(parts["avatar"]).splats)
    arguments = ["--turntable", "--cameras", str(cameras), "--seconds", "0.2"]
    assert stga("render", ply, "--video", tmp_path / "v.mp4", *arguments) == 0
    assert len(decoded(tmp_path / "v.mp4")[1]) == 5
