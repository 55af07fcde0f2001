"""Images of several moments as people store them: which camera and which moment each is of."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from stga_addon.files import write_json
from stga_addon.tracking.footage.moments import find_moments
from stga_addon.tracking.footage.open import open_footage

from .scenes import HEIGHT, WIDTH, rig, write_colmap_text, write_image, write_video
from .test_calibrations import entry, write_transforms

CAMERAS = ("01", "02", "03")


def noisy(camera, seed):
    """The camera as a calibration of another moment finds it."""
    shift = np.random.default_rng(seed).normal(0, 0.002, 3)
    pose = camera.world_to_camera.copy()
    pose[:3, 3] += shift
    return replace(camera, world_to_camera=pose)


def colmap_on_all(root, pattern):
    """A model of every image, whose poses differ by noise."""
    names = [pattern.format(c, t) for t in range(2) for c in CAMERAS]
    cameras = [noisy(own, n) for n, own in enumerate([*rig(), *rig()])]
    write_colmap_text(root / "sparse/0", cameras, names)
    for name in names:
        write_image(root / "images" / name)


def colmap_on_one(root, pattern):
    """A model of the first moment, with the names of cameras."""
    write_colmap_text(root / "sparse/0", rig(), [f"cam_{own}.png" for own in CAMERAS])
    for moment in range(2):
        for own in CAMERAS:
            write_image(root / "images" / pattern.format(own, moment))


def camera_params(root, pattern, scale=2):
    """NeRSemble's file, of images of twice the size, beside masks of the images' names."""
    cameras = dict(zip(CAMERAS, rig(), strict=True))
    one = rig()[0]
    matrix = [
        [one.fl_x * scale, 0, one.cx * scale],
        [0, one.fl_y * scale, one.cy * scale],
        [0, 0, 1],
    ]
    poses = {name: own.world_to_camera.tolist() for name, own in cameras.items()}
    values = {"world_2_cam": poses, "intrinsics": matrix}
    write_json(root / "calibration/camera_params.json", values)
    for moment in range(2):
        for own in CAMERAS:
            write_image(root / pattern.format(own, moment))
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[3:-5, int(own) : -3] = 40 * moment  # inverted: the head is what it leaves out
            path = root / pattern.format(own, moment).replace("images", "alpha_map")
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask).save(path)


def video_in_each_folder(root, pattern):
    frames = [entry(own, f"cam{name}/0001.png") for name, own in zip(CAMERAS, rig(), strict=True)]
    write_transforms(root, frames)
    for own in CAMERAS:
        write_video(root / pattern.format(own, 0), [10, 20])


@pytest.mark.parametrize(
    ("write", "pattern"),
    [
        (colmap_on_all, "cam{}/frame_{:05}.png"),
        (colmap_on_all, "frame_{1:05}/cam{0}.png"),
        (colmap_on_all, "{1:05}_cam_{0}.png"),
        (colmap_on_all, "cam{0}_{1:05}.png"),
        (colmap_on_one, "frame_{1:05}/cam_{0}.png"),
        (colmap_on_one, "cam_{0}_{1:05}.png"),
        (camera_params, "timesteps/frame_{1:05}/images-2fps/cam_{0}.png"),
        (camera_params, "images/cam_{0}_{1:06}.png"),
        (video_in_each_folder, "cam{}/rgb.mp4"),
        (video_in_each_folder, "videos/cam{0}/take{0}.mp4"),
    ],
)
def test_a_rig_at_several_moments(tmp_path, write, pattern):
    """Catches each image of a rig that stands still taken for a camera, or each camera for a
    frame; masks of the images' names taken for images, for those of another camera, or inverted as
    they are; matrices of another size taken as they are."""
    write(tmp_path, pattern)
    footage = open_footage(tmp_path)
    assert footage.timesteps == (0, 1)
    assert [camera.timesteps for camera in footage.cameras] == [(0, 1)] * 3
    for found, expected in zip(footage.cameras, rig(), strict=True):
        camera = found.camera
        np.testing.assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=0.01)
        assert (camera.fl_x, camera.cx, camera.cy) == (expected.fl_x, WIDTH / 2, HEIGHT / 2)
        assert "alpha" not in found.source(0)
        if write is camera_params:
            for timestep in (0, 1):
                mask = found.mask(timestep)
                assert mask[0, 0] == 0
                assert (mask[3:-5, int(found.name[-2:]) : -3] == 255 - 40 * timestep).all()
                assert mask[3, int(found.name[-2:]) - 1] == 0


@pytest.mark.parametrize("names", [[f"frame_{n:03}" for n in range(12)], [*"abcdefghijkl"]])
@pytest.mark.parametrize("folders", ["", "first/ second/", "high/ low/ low2/"])
def test_a_still_head_filmed_around_is_one_moment(names, folders):
    """Catches a moving camera's photos, in one folder or several, taken for a rig's moments."""
    tops = folders.split() or [""]
    labels = [f"{top}{name}" for top in tops for name in names]
    poses = [own.world_to_camera for own in rig(len(labels))]
    moments = find_moments(labels, poses)
    assert not moments.is_rig
    assert set(moments.timesteps) == {0}
    assert moments.cameras == tuple(labels)


@pytest.mark.parametrize("key", ["expression", "exp_path"])
def test_head_fixed_poses_are_of_one_camera(tmp_path, key):
    """Catches a clip of NeRFace or INSTA, whose poses are relative to the head, taken for a camera
    an image around a still head."""
    values = {key: "flame/exp/0.txt" if key == "exp_path" else [0.1, 0.2]}
    frames = [entry(own, f"images/{n}.png", **values) for n, own in enumerate(rig())]
    write_transforms(tmp_path, frames)
    for number in range(3):
        write_image(tmp_path / f"images/{number}.png")
    footage = open_footage(tmp_path)
    (camera,) = footage.cameras
    assert camera.timesteps == (0, 1, 2)
    assert camera.camera.fl_x == rig()[0].fl_x
    assert "moments of one camera" in " ".join(footage.warnings)
