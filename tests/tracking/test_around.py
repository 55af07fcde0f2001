"""Takes around a still head: recognized, and given cameras without a calibration."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from refusal import refusal
from scipy.spatial.transform import Rotation

from stga_addon.capture.lens import Lens
from stga_addon.capture.mesh_geometry import similarity
from stga_addon.development.demo.capture import unpack_takes
from stga_addon.jobs import track
from stga_addon.tracking import around, structure_from_motion
from stga_addon.tracking.around import Recognition, take_of
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.sharp_frames import sharpest
from stga_addon.tracking.stages import Workers
from stga_addon.worker.helpers import Helpers

from .scenes import encode
from .walk import picture, walk

COUNT = 8


def write_pictures(folder, images):
    folder.mkdir()
    for number, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{number}.png")
    return folder


def distorted(image, camera, k):
    """What a lens of radial distortion k records of a pinhole's image."""
    import cv2

    rows, columns = np.indices(image.shape[:2])
    recorded = camera.at_depth_one(np.stack([columns, rows], axis=-1) + 0.5)
    ideal = recorded
    for _ in range(20):
        ideal = recorded / (1 + k * (ideal**2).sum(-1, keepdims=True))
    assert np.abs(Lens(radial=(k,)).distort(ideal) - recorded).max() < 1e-6
    at = ideal * [camera.fl_x, camera.fl_y] + [camera.cx, camera.cy] - 0.5
    return cv2.remap(image, at.astype(np.float32), None, cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def pictures():
    return [picture(camera) for camera in walk(COUNT)]


def found(folder, out, take="auto", most=None):
    asked = track.Track(folder, None, out, take=take, most=most)
    footage, lines = track._open(asked, track._Steps(lambda progress: None))
    return footage, " ".join(lines)


@pytest.mark.slow
@pytest.mark.parametrize("k", [0.0, -0.3])
def test_cameras_are_those_that_filmed(tmp_path, pictures, k):
    """Catches poses, a lens or a principal point of another convention, a distortion that is left
    in, or made of noise, and a walk that is taken for a talk, also for a quick look, whose frames
    of a walk are not fewer; photos, and a video with a lens."""
    pytest.importorskip("pycolmap")
    cameras = walk(COUNT)
    source = tmp_path / "walk.mp4"
    if k:  # of so few frames, the room tells too little for the take to be recognized
        images = [distorted(*pair, k) for pair in zip(pictures, cameras, strict=True)]
        encode(source, images, options={"crf": "8"}, rate=2)
    else:
        source = write_pictures(tmp_path / "photos", pictures)
    footage, line = found(source, tmp_path / "out", "around" if k else "auto", most=4)
    assert re.search(rf"around a still head.*cameras of {COUNT} of {COUNT} images found", line)
    assert ("distortion" in line) == bool(k)
    assert footage.timesteps == (0,)
    assert footage.warnings == ()
    placed = np.stack([own.camera.position for own in footage.cameras])
    truth = np.stack([camera.position for camera in cameras])
    world = similarity(placed, truth)
    apart = np.linalg.norm(world.apply(placed) - truth, axis=1)
    assert apart.max() < 0.005 * np.linalg.norm(truth[0])
    for own, camera, image in zip(footage.cameras, cameras, pictures, strict=True):
        turned = own.camera.world_to_camera[:3, :3] @ world.rotation.T
        off = Rotation.from_matrix(turned @ camera.world_to_camera[:3, :3].T)
        assert np.degrees(off.magnitude()) < 0.3
        if k:
            lens = own.undistortion
            assert lens.recorded.fl_x == pytest.approx(camera.fl_x, rel=0.05)
            assert lens.lens.radial[0] == pytest.approx(k, rel=0.1)
            assert own.image(0).shape == image.shape
        else:
            assert own.camera.fl_x == pytest.approx(camera.fl_x, rel=0.02)
            np.testing.assert_array_equal(own.image(0), image)


@pytest.mark.slow
def test_images_that_a_wrong_focal_length_loses(tmp_path, pictures, monkeypatch):
    """Catches photos at the ends of a walk that are left out, or placed wrong, because COLMAP began
    from a focal length that is far off."""
    pytest.importorskip("pycolmap")
    mapped = structure_from_motion._Search._mapped
    begun = []

    def without_the_last(search, step):
        model = mapped(search, step)
        with search._colmap.Database.open(search._folder / "features.db") as database:
            begun.append(database.read_all_cameras()[0].params[0])
        for image in list(model.reg_image_ids())[-2:] if len(begun) == 1 else ():
            model.deregister_frame(model.image(image).frame_id)
        return model

    monkeypatch.setattr(structure_from_motion._Search, "_mapped", without_the_last)
    camera = open_footage(write_pictures(tmp_path / "photos", pictures)).cameras[0]
    options = structure_from_motion.SearchOptions(None, False, False, 1, 1, 0)
    found = structure_from_motion.find_structure(
        camera, list(range(COUNT)), options, tmp_path / "scratch", lambda: None
    )
    assert found["timesteps"].tolist() == list(range(COUNT))
    assert begun[0] == 1.2 * 256  # COLMAP's guess
    assert begun[1:] == pytest.approx([walk(1)[0].fl_x], rel=0.05)


@pytest.mark.nightly
def test_many_photos_from_behind_ear_to_ear(tmp_path):
    """Catches photos in small steps, of which those that are looked at share no room."""
    photos = write_pictures(tmp_path / "photos", [picture(own) for own in walk(32, 200.0)])
    with Helpers(1) as helpers:
        kind, why = take_of(open_footage(photos), Workers(helpers))
    assert (kind, "the room moves with it" in why) == ("around", True)


def test_a_video_all_around_the_head(tmp_path):
    """Catches a walk that is tracked as a talk: its few samples with a face do not show that the
    papered room moves, or the camera moves too far in the time between two frames."""
    around, talk = map(open_footage, unpack_takes(tmp_path))
    hurried = replace(around, fps=10.0)  # 330° in four seconds
    for footage, expected in ((around, "around"), (hurried, "around"), (talk, "talk")):
        with Helpers(1) as helpers:
            assert take_of(footage, Workers(helpers))[0] == expected


def test_a_head_that_turns_before_a_camera_is_none(tmp_path):
    """Catches a talk that pays for structure from motion, or loses its timesteps to it."""
    still = walk(3)[1]
    turns = [Rotation.from_euler("y", y, degrees=True).as_matrix() for y in np.linspace(-30, 30, 8)]
    folder = write_pictures(tmp_path / "talk", [picture(still, turn) for turn in turns])
    footage, line = found(folder, tmp_path / "out")
    assert (footage.timesteps, footage.focal) == (tuple(range(8)), "usual")
    assert "a head that moves in front of a camera" in line
    assert "the room does not move with it" in line


def test_a_take_that_is_known_is_not_recognized_again(tmp_path, monkeypatch):
    """Catches takes of one avatar whose frames are looked at twice."""
    folder = write_pictures(tmp_path / "photos", [np.zeros((8, 8, 3), np.uint8)] * COUNT)
    monkeypatch.delattr(around, "take_of")
    asked = track.Track(folder, None, tmp_path / "out")
    steps = track._Steps(lambda progress: None)
    footage, lines = track._open(asked, steps, ("talk", "as seen before"))
    assert len(footage.timesteps) == COUNT
    assert "a head that moves in front of a camera (as seen before; " in lines[0]


@pytest.mark.parametrize(
    ("seen", "expected"),
    [
        ((85, np.nan, 0.0, 0.022), ("around", "85° apart")),
        ((85, np.nan, 0.0, 0.21), ("talk", "the mouth moves")),
        ((85, 0.5, 0.9, 0.21), ("around", "the room moves with it")),
        ((85, 0.0, 0.9, 0.0), ("talk", "the room does not move with it")),
        ((20, np.nan, 0.0, 0.0), ("talk", "20° apart")),
    ],
)
def test_photos_before_a_plain_wall(tmp_path, monkeypatch, seen, expected):
    """Catches photos of somebody who talks and turns before a plain wall, which count as one moment
    of a still head, and photos of a still head that do not."""
    folder = write_pictures(tmp_path / "photos", [np.zeros((8, 8, 3), np.uint8)] * COUNT)
    monkeypatch.setattr(around, "_recognized", lambda *_: Recognition(*seen))
    with Helpers(1) as helpers:
        kind, why = take_of(open_footage(folder), Workers(helpers))
    assert kind == expected[0]
    assert expected[1] in why


@pytest.mark.slow
def test_why_no_cameras_are_found(tmp_path, monkeypatch):
    """Catches a take without detail that is tracked by cameras of chance, that is refused where
    the old way serves, and a refusal that does not help."""
    pytest.importorskip("pycolmap")
    images = [picture(camera, plain=True) for camera in walk(COUNT)]
    folder = write_pictures(tmp_path / "plain", images)
    footage, line = found(folder, tmp_path / "out")
    assert (len(footage.cameras), line) == (1, "")
    why = (
        f"still head, but .*places [0-7] of {COUNT} images, expected at least 8; film in even light"
    )
    assert re.search(why, footage.warnings[-1])
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with refusal("needs the package pycolmap"):
        found(folder, tmp_path / "out", "around")


def test_the_sharpest_of_each_stretch_is_chosen():
    """Catches frames at equal times, where the camera stood, and blurred ones."""
    random = np.random.default_rng(0)
    speed = np.r_[np.zeros(30), np.full(60, 0.02), np.zeros(30)]
    flows = np.stack([speed, 0 * speed], axis=1) + random.normal(0, 1e-3, (120, 2))
    sharpness = random.uniform(1, 2, 120)
    sharpness[40::10] = 3.0
    chosen = sharpest(flows, sharpness, 6)
    assert chosen.tolist() == sorted(set(chosen.tolist()))
    assert len(chosen) == 6
    assert (np.isin(chosen, np.arange(40, 120, 10))).sum() >= 5
    path = np.cumsum(speed)[chosen]
    assert np.diff(path).min() > 0
