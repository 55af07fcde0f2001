"""Frames of folders and videos, in step."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusal import refusal

from stga_addon.render.video import video_writer
from stga_addon.tracking.footage.model import write_png
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.footage.sequences import FrameRange

from .scenes import HEIGHT, WIDTH, rig, write_colmap_text, write_image, write_video


def write_folders(root, counts=(6, 6), first=1, parent="images"):
    """Cameras a and b with images numbered from `first`; camera c's red is 10 (c + 1) + number."""
    names = "abcdef"[: len(counts)]
    write_colmap_text(
        root / "sparse/0", rig(len(counts)), [f"{name}/frame_1.png" for name in names]
    )
    for camera, (name, count) in enumerate(zip(names, counts, strict=True)):
        for number in range(first, first + count):
            write_image(root / parent / name / f"frame_{number}.png", 100 * (camera + 1) + number)


def red(footage):
    return {
        camera.name: [int(camera.image(t)[0, 0, 0]) for t in camera.timesteps]
        for camera in footage.cameras
    }


def test_folders_in_natural_order(tmp_path):
    """Catches frame 10 before frame 2, and a rig calibrated with one image taken for one moment."""
    write_folders(tmp_path, (12, 12))
    footage = open_footage(tmp_path)
    assert footage.timesteps == tuple(range(12))
    assert footage.fps is None
    assert red(footage) == {"a": [*range(101, 113)], "b": [*range(201, 213)]}
    assert footage.cameras[0].file(9) == tmp_path / "images/a/frame_10.png"


def test_range_step_and_offset(tmp_path):
    """Catches an offset of the wrong sign, a range in other units than timesteps, and a lost
    timestep number."""
    write_folders(tmp_path, (8, 12))
    footage = open_footage(tmp_path, frames=FrameRange(1, 8, 3, {"b": 2}))
    assert footage.timesteps == (1, 4, 7)
    assert red(footage) == {"a": [102, 105, 108], "b": [204, 207, 210]}
    footage = open_footage(tmp_path, frames=FrameRange(0, 8, most=3))
    assert footage.timesteps == (0, 4, 7)
    footage = open_footage(tmp_path, frames=FrameRange(offsets={"b": -1}))
    assert footage.timesteps == tuple(range(1, 8))
    assert red(footage) == {"a": [*range(102, 109)], "b": [*range(201, 208)]}


def without_one_frame(images):
    write_image(images / "a/frame_7.png")
    (images / "a/frame_4.png").unlink()


def without_a_recording(images):
    for path in (images / "b").iterdir():
        path.unlink()


def of_other_size(images, numbers=range(1, 7)):
    for number in numbers:
        write_image(images / f"b/frame_{number}.png", size=(20, 20))


def of_other_length(images):
    (images / "b/frame_6.png").unlink()


@pytest.mark.parametrize(
    ("damage", "frames", "message"),
    [
        (
            of_other_length,
            FrameRange(),
            "b has 5 frames and camera a 6; expected recordings of the same length",
        ),
        (of_other_length, FrameRange(0, 6), "Camera b has 5 frames; expected all up to 6"),
        (
            None,
            FrameRange(0, 6, 1, {"b": 1}),
            "b has 6 frames; expected all up to 6 and its offset",
        ),
        (None, FrameRange(offsets={"z": 1}), "Offset for camera z: expected one of a, b"),
        (None, FrameRange(9), "Frames from 9 on: the cameras have only 6 in common"),
        (
            without_one_frame,
            FrameRange(),
            r"b/frame_4.png: is 3 frames after the first of camera b, where camera a ",
        ),
        (
            without_a_recording,
            FrameRange(),
            r"image 'b/frame_1.png': .* has no folder or video of this camera",
        ),
        (
            of_other_size,
            FrameRange(),
            r"b/frame_1.png: has 20 x 20 pixels, but .* image 'b/frame_1.png' has 40 x 30",
        ),
        (
            lambda images: of_other_size(images, [3]),
            FrameRange(),
            r"b/frame_3.png: has 20 x 20 pixels, but .* image 'b/frame_1.png' has 40 x 30",
        ),
    ],
)
def test_recordings_out_of_step(tmp_path, damage, frames, message):
    """Catches frames of different moments silently paired, all later frames of a camera being one
    too early because one file is missing, a camera that disappears from the footage, and images of
    another resolution than the calibration's, all of them or from some frame on."""
    write_folders(tmp_path)
    if damage is not None:
        damage(tmp_path / "images")
    with refusal(message):
        open_footage(tmp_path, frames=frames)


def test_masks_beside_the_images(tmp_path):
    """Catches masks of another camera or frame, and COLMAP's names of masks."""
    write_folders(tmp_path)
    write_image(tmp_path / "masks/a/frame_2.png", 255)
    write_image(tmp_path / "masks/b/frame_3.png.png", 77)
    first, second = open_footage(tmp_path).cameras
    assert first.mask(0) is None
    assert first.mask(1)[0, 0] == 255
    assert second.mask(2)[0, 0] == 77


def test_several_images_of_one_folder_are_several_cameras(tmp_path):
    """Catches the images of a camera that moves around a still head taken for a sequence."""
    names = ["walk/1.png", "walk/2.png", "walk/3.png"]
    write_colmap_text(tmp_path / "sparse", rig(), names)
    for number, name in enumerate(names):
        write_image(tmp_path / name, number)
    footage = open_footage(tmp_path)
    assert red(footage) == {f"walk/{number + 1}": [number] for number in range(3)}


def write_videos(root, counts=(12, 12), rates=(25, 25)):
    pytest.importorskip("av")
    names = "ab"[: len(counts)]
    write_colmap_text(root / "calibration", rig(len(counts)), [f"{name}.jpg" for name in names])
    for camera, (name, count, rate) in enumerate(zip(names, counts, rates, strict=False)):
        values = [60 + 10 * n + 5 * camera for n in range(count)]
        write_video(root / f"videos/{name}.mp4", values, rate=rate)


def test_range_of_videos(tmp_path):
    """Catches offsets and steps that videos do not follow as folders do."""
    write_videos(tmp_path, (12, 14))
    footage = open_footage(tmp_path, tmp_path / "calibration", FrameRange(2, 12, 4, {"b": 2}))
    assert footage.timesteps == (2, 6, 10)
    found = [footage.cameras[1].image(t).mean() for t in (2, 6, 10)]
    assert_allclose(found, [105, 145, 185], atol=3)


@pytest.mark.parametrize(
    ("rate", "damage", "message"),
    [
        (30, None, r"camera b has 30 frames a second, that of camera a 25; expected one rate"),
        (25, "cut", r"b.mp4: is not a readable video"),
        (25, "no av", r"a.mp4: reading videos needs the package av \(PyAV\)"),
    ],
)
def test_videos_that_cannot_be_used(tmp_path, monkeypatch, rate, damage, message):
    """Catches 25 and 30 frames a second paired by number, an exception of FFmpeg's, and a traceback
    where the package is missing."""
    write_videos(tmp_path, rates=(25, rate))
    path = tmp_path / "videos/b.mp4"
    path.write_bytes(path.read_bytes()[: 200 if damage == "cut" else None])
    if damage == "no av":
        monkeypatch.setitem(sys.modules, "av", None)
    with refusal(message):
        open_footage(tmp_path, tmp_path / "calibration")


def test_one_video_without_calibration(tmp_path):
    """Catches a guessed focal length that is passed off as known."""
    pytest.importorskip("av")
    write_video(tmp_path / "phone.mp4", [60, 90, 120], size=(64, 48), rate=30)
    for path in (tmp_path, tmp_path / "phone.mp4"):
        footage = open_footage(path)
        assert (footage.focal, footage.fps, footage.timesteps) == ("usual", 30, (0, 1, 2))
        assert footage.cameras[0].camera.fl_x == pytest.approx(40 / np.tan(np.radians(32.5)))
        assert [camera.name for camera in footage.cameras] == ["phone"]
    known = open_footage(tmp_path, focal=55.0)
    assert known.focal == "given"
    assert (known.cameras[0].camera.fl_x, known.cameras[0].camera.cx) == (55.0, 32.0)


@pytest.mark.skipif(os.name == "nt", reason="no file has such a name")
@pytest.mark.parametrize("name", ["take12:30.mp4", "http:.mp4", "concat:a|b.mp4", "-i.mp4"])
def test_names_that_are_protocols(tmp_path, monkeypatch, name):
    """Catches a relative name taken for a protocol of FFmpeg, read or written."""
    pytest.importorskip("av")
    write_video(tmp_path / "plain.mp4", [60, 90, 120], size=(64, 48))
    monkeypatch.chdir(tmp_path)
    Path("plain.mp4").rename(name)
    camera = open_footage(Path(name)).cameras[0]
    assert [camera.image(timestep).mean() for timestep in (0, 2)] == pytest.approx([60, 120], abs=3)
    Path(name).unlink()
    with video_writer(Path(name), 25) as append:
        append(np.full((48, 64, 3), 80, np.uint8))
    (again,) = open_footage(Path(name)).cameras
    assert_allclose(again.image(0), 80, atol=3)


def test_two_cameras_without_calibration(tmp_path):
    """Catches a rig without poses taken for one camera, a traceback where a folder's name ends as
    an export's does, and the RuntimeError by which resolving a loop of links ends."""
    (tmp_path / "old.xml").mkdir()
    (tmp_path / "old.csv").mkdir()
    write_image(tmp_path / "a/1.png")
    write_image(tmp_path / "b/1.png")
    message = r"has 2 cameras \(a, b\) and no calibration; expected transforms.json, a COLMAP model"
    with refusal(message):
        open_footage(tmp_path)
    (tmp_path / "empty").mkdir()
    with refusal(r"has neither images nor videos and no calibration"):
        open_footage(tmp_path / "empty")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with refusal("loop: does not exist"):
        open_footage(tmp_path / "loop")


def test_a_kept_frame_is_that_of_the_video_or_named(tmp_path):
    """Catches a kept frame whose colors are swapped, and one that was cut off and is shown as far
    as it goes, or cannot be read for a reason that names no file."""
    write_video(tmp_path / "one.mp4", (60, 90))
    (camera,) = open_footage(tmp_path / "one.mp4").cameras
    kept = replace(camera, kept={0: tmp_path / "0.png"})
    pixels = camera.image(0).copy()
    pixels[:4, :, 0] = 200
    write_png(tmp_path / "0.png", pixels[..., ::-1])
    assert (kept.image(0) == pixels).all()
    whole = (tmp_path / "0.png").read_bytes()
    for size in (0, 40, len(whole) // 2):
        (tmp_path / "0.png").write_bytes(whole[:size])
        with refusal("0.png"):
            kept.image(0)


def test_distorted_frames_are_undistorted(tmp_path):
    """Catches frames handed out as recorded beside a pinhole camera that does not show them."""
    pytest.importorskip("cv2")
    lens = 50.0, WIDTH / 2, HEIGHT / 2, -0.3
    write_colmap_text(tmp_path / "sparse", rig(1), ["a.png"], "SIMPLE_RADIAL", lens)
    write_image(tmp_path / "a/1.png", 90)
    write_image(tmp_path / "masks/a/1.png", 255)
    camera = open_footage(tmp_path).cameras[0]
    assert camera.camera.fl_x < 50
    assert camera.image(0).shape == (HEIGHT, WIDTH, 3)
    assert camera.mask(0).shape == (HEIGHT, WIDTH)
    assert camera.file(0) is None
