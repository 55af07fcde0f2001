"""Footage of transforms files."""

import json

import numpy as np
import pytest

from stga_addon.errors import StgaError
from stga_addon.tracking.footage.open import open_footage

from .scenes import HEIGHT, rig, write_image


def entry(camera, path, **values):
    intrinsics = {key: getattr(camera, key) for key in ("fl_x", "fl_y", "cx", "cy")}
    pose = {"transform_matrix": camera.camera_to_world_gl.tolist()}
    size = {"w": camera.width, "h": camera.height}
    return {"file_path": path, **size, **intrinsics, **pose, **values}


def write_transforms(folder, frames, name="transforms.json", **top):
    for number, frame in enumerate(frames):
        write_image(folder / frame["file_path"], 10 * number)
    (folder / name).write_text(json.dumps({**top, "frames": frames}), encoding="utf-8")


def test_a_capture_is_footage(tmp_path):
    """Catches frames that belong to another camera or timestep than the file says, and a flipped
    principal point."""
    frames = []
    for t in (0, 3):
        for c, camera in enumerate(rig(2)):
            named = {"timestep_index": t, "camera_index": c, "camera_id": f"cam{c}"}
            frames.append(entry(camera, f"images/{t:05d}_{c:02d}.png", **named, cy=12.0))
    write_transforms(tmp_path, frames)
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["cam0", "cam1"]
    assert footage.timesteps == (0, 3)
    assert [camera.image(t)[0, 0, 0] for t, camera in footage.views()] == [0, 20, 10, 30]
    assert footage.cameras[1].file(3) == tmp_path / "images/00003_01.png"
    assert footage.cameras[0].camera.cy == HEIGHT - 12.0
    found, expected = footage.cameras[1].camera, rig(2)[1]
    np.testing.assert_allclose(found.world_to_camera, expected.world_to_camera, atol=1e-9)


def test_one_image_per_pose_is_one_timestep(tmp_path):
    """Catches a nerfstudio file, whose images have no timesteps, taken for a sequence; and its `cy`
    turned over."""
    frames = [entry(c, f"images/{n}.png", cy=12.0) for n, c in enumerate(rig())]
    write_transforms(tmp_path, frames, camera_model="OPENCV")
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["0", "1", "2"]
    assert footage.timesteps == (0,)
    assert footage.cameras[0].camera.cy == 12.0


def test_splits_are_one_rig(tmp_path):
    """Catches a camera that is two because it appears in two splits."""
    first, second = rig(2)
    train = [entry(first, "a/0.png", timestep_index=0), entry(second, "a/1.png", timestep_index=0)]
    write_transforms(tmp_path, train, "transforms_train.json")
    write_transforms(tmp_path, [entry(first, "a/2.png", timestep_index=1)], "transforms_val.json")
    footage = open_footage(tmp_path)
    assert [camera.timesteps for camera in footage.cameras] == [(0, 1), (0,)]


@pytest.mark.parametrize(("change", "message"), [
    ({"file_path": "images/none.png"}, r"frames\[1\]: .* has no image, folder or video of"),
    ({"mask_path": "masks/none.png"}, r"masks/none.png: does not .*frames\[1\] names it"),
])  # fmt: skip
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_bad_entries_are_named(tmp_path, change, message):
    """Catches a traceback, or a message without file and field."""
    first, second = rig(2)
    write_transforms(tmp_path, [entry(first, "images/0.png"), entry(second, "images/1.png")])
    values = json.loads((tmp_path / "transforms.json").read_text(encoding="utf-8"))
    values["frames"][1].update(change)
    (tmp_path / "transforms.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(StgaError, match=message):
        open_footage(tmp_path)


def test_two_images_of_one_moment(tmp_path):
    """Catches a sequence of a camera that stands still taken for a rig, and a frame that replaces
    another."""
    camera = rig(1)[0]
    write_transforms(tmp_path, [entry(camera, "images/0.png"), entry(camera, "images/1.png")])
    message = r"frames\[1\]: has the pose of images/0.png; expected a timestep_index"
    with pytest.raises(StgaError, match=message):
        open_footage(tmp_path)
    frames = [entry(camera, f"images/{n}.png", timestep_index=4, camera_index=7) for n in range(2)]
    write_transforms(tmp_path, frames)
    with pytest.raises(StgaError, match=r"frames\[1\]: camera 07 has two images at timestep 4"):
        open_footage(tmp_path)
