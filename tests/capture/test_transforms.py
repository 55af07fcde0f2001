"""Cameras, frames and paths of the transforms files."""

import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusal import refusal

from stga_addon.capture.transforms import inside, read_splits, read_transforms

from . import factory


def read_one(folder, entry, principal_point="vhap", **shared):
    path = folder / "transforms.json"
    path.write_text(json.dumps({**shared, "frames": [entry]}))
    return read_transforms(path, principal_point)[0]


def views_of(folder, frames):
    """The views of a single file of frames."""
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return [frame.view for frame in read_splits(folder).frames]


@pytest.mark.parametrize(
    ("convention", "cx", "cy"), [("vhap", 19.0, 36.0), ("opencv", 19.0, 24.0), ("center", 20, 30)]
)
def test_projection_is_that_of_an_opengl_camera(tmp_path, convention, cx, cy):
    """Catches a wrong axis flip, an inverted pose, or a convention of the principal point mixed up,
    by the textbook OpenGL formula: the file holds cx 19 and cy 24 of a 40 x 60 image."""
    camera = read_one(tmp_path, factory.frame(0, 2), convention).view.camera
    points = np.random.default_rng(0).normal(scale=0.1, size=(50, 3))
    x, y, z, _ = np.linalg.inv(factory.pose(2)) @ np.c_[points, np.ones(50)].T
    u = cx + factory.FOCAL * x / -z
    v = cy - factory.FOCAL * y / -z
    pixels, depth = camera.project(points)
    assert_allclose(pixels, np.c_[u, v], atol=1e-9)
    assert_allclose(depth, -z, atol=1e-12)
    assert_allclose(camera.camera_to_world_gl, factory.pose(2), atol=1e-12)


def test_own_intrinsics_win(tmp_path):
    """Catches a reader that trusts the top level, which real exports get wrong, or loses it as a
    fallback; a frame's own angle wins over a focal length at the top."""
    own = factory.frame(0, 0)
    half = {"w": 8, "h": 8, "cx": 1.0, "cy": 1.0}
    bare = {key: own[key] for key in ("file_path", "transform_matrix")}
    shared = {"w": 40, "h": 60, "camera_angle_x": 2 * math.atan(20 / 200)}
    angles = {"camera_angle_x": 2 * math.atan(20 / 300), "camera_angle_y": 2 * math.atan(30 / 150)}
    written = 40, 60, factory.FOCAL, factory.FOCAL, factory.CX, factory.CY
    for entry, top, expected in (
        (own, {"fl_x": 7.0, "fl_y": 7.0, "camera_angle_x": 1.0, **half}, written),
        (bare, shared, (40, 60, 200, 200, 20, 30)),
        ({**bare, **angles}, {**shared, "fl_x": 5.0}, (40, 60, 300, 150, 20, 30)),
    ):
        camera = read_one(tmp_path, entry, **top).view.camera
        found = camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy
        assert found == pytest.approx(expected)


def test_cameras_are_numbered_alike_in_all_splits(tmp_path):
    """Catches the camera of `val` taking a training camera's number where none is given."""
    write = factory.write_mesh_capture(tmp_path / "capture")
    for keep_id in (True, False):
        for split in factory.SPLITS:

            def strip(document, keep_id=keep_id):
                for entry in document["frames"]:
                    entry.pop("camera_index", None)
                    if not keep_id:
                        entry.pop("camera_id", None)

            factory.edit(write / f"transforms_{split}.json", strip)
        splits = read_splits(write).splits
        where = {name: {f.view.camera_index for f in frames} for name, frames in splits.items()}
        assert where == {"train": {0, 1}, "val": {2}, "test": {0, 1, 2}}


def test_cameras_of_a_single_file(tmp_path):
    """Catches one camera taken for two by a zero's sign, or two for one, and frames lost."""
    frames = [factory.frame(0, 0), factory.frame(1, 0), factory.frame(1, 1)]
    matrix = np.array(frames[1]["transform_matrix"])
    matrix[:3] -= 1e-9
    frames[1]["transform_matrix"] = matrix.tolist()
    for entry in frames:
        del entry["camera_index"], entry["camera_id"]
    assert [view.camera_index for view in views_of(tmp_path, frames)] == [0, 0, 1]
    frames = [factory.frame(timestep, int(timestep == 4)) for timestep in range(5)]
    frames[2]["fl_x"] += 1.0
    frames[3]["cy"] += 1.0
    cameras = [view.camera for view in views_of(tmp_path, frames)]
    assert cameras[0] is cameras[1]
    assert len({id(camera) for camera in cameras}) == 4
    assert cameras[2].fl_x == cameras[0].fl_x + 1
    assert cameras[3].cy != cameras[0].cy
    splits = read_splits(tmp_path).splits
    assert {name: len(own) for name, own in splits.items()} == {"train": 5, "val": 0, "test": 0}


def test_static_capture_without_timesteps(tmp_path):
    """Catches a plain NeRF transforms file being refused."""
    factory.write_images(tmp_path, [0], [0])
    entry = {"file_path": "images/00000_00", "transform_matrix": factory.pose(0).tolist()}
    frame = read_one(tmp_path, entry, camera_angle_x=0.5)
    assert (frame.view.timestep, frame.view.camera_index) == (0, 0)
    assert (frame.view.camera.width, frame.view.camera.height) == (factory.WIDTH, factory.HEIGHT)
    assert frame.view.name == "images/00000_00"
    assert frame.view.image == tmp_path / "images/00000_00.png"


def test_paths_without_suffix(tmp_path):
    """Catches images that are JPEGs, or masks, being missed where a path leaves out the suffix."""
    for name in ("a.jpg", "b.PNG", "c.0001.jpeg", "d.jpg", "d.png"):
        (tmp_path / name).touch()
    for path, found in (
        ("a", "a.jpg"),
        ("b", "b.PNG"),
        ("c.0001", "c.0001.jpeg"),
        ("d", "d.png"),
        ("e", "e.png"),
        ("d.jpg", "d.jpg"),
    ):
        view = read_one(tmp_path, factory.frame(0, 0, file_path=path, fg_mask_path=path)).view
        assert (view.image.name, view.mask.name, view.name) == (found, found, path)


def test_poses_as_programs_write_them(tmp_path):
    """Catches a matrix of three rows, in one line, or with a scale, as a camera in Blender may
    have, being refused; and a scale that is not taken out, or moves the camera."""
    own = factory.pose(2)
    own[:3, 3] = 0.3, 0.5, 0.9
    expected = read_one(tmp_path, factory.frame(0, 2, transform_matrix=own.tolist()))
    scaled = own * [2.0, 2.0, 0.25, 1.0]
    for matrix, repairs in ((own[:3], 0), (own.ravel(), 0), (scaled, 1), (scaled[:3], 1)):
        frame = read_one(tmp_path, factory.frame(0, 2, transform_matrix=matrix.tolist()))
        assert_allclose(
            frame.view.camera.world_to_camera, expected.view.camera.world_to_camera, atol=1e-12
        )
        assert len(frame.repairs) == repairs


@pytest.mark.parametrize(
    ("names", "timesteps"),
    [
        (("0004.obj", "take2_0007.obj"), [4, 7]),
        (("a.obj", "b.obj"), [0, 1]),
        (("x/1.obj", "y/1.obj"), [0, 1]),
        (("a.obj", "a.obj"), [0, 0]),
    ],
)
@pytest.mark.parametrize("field", ["mesh_path", "flame_param_path"])
def test_timesteps_of_monocular_trackers(tmp_path, names, timesteps, field):
    """Catches frames without timestep_index, as INSTA writes them, all taken for timestep 0."""
    frames = [factory.frame(0, 0, **{field: name}) for name in names]
    for frame in frames:
        del frame["timestep_index"]
    assert [view.timestep for view in views_of(tmp_path, frames)] == timesteps
    found = read_transforms(tmp_path / "transforms.json")
    assert [frame.view.timestep for frame in found] == timesteps


def test_union_paths_stay_beside_the_capture(tmp_path):
    """Catches VHAP's union sets, whose frames lie in sibling folders, being refused."""
    root = tmp_path / "union"
    assert inside(root, "../seq_01/images/1.png", "x") == tmp_path / "seq_01/images/1.png"
    assert inside(root, "images/../../seq_01\\1.png", "x") == tmp_path / "seq_01/1.png"
    assert inside(root, "./images//1.png", "x") == root / "images/1.png"
    assert inside(root, "..foo/1.png", "x") == root / "..foo/1.png"


@pytest.mark.parametrize(
    "path",
    [
        "../../secret.png",
        "images/../../../secret.png",
        "../seq/../../secret.png",
        "..\\..\\secret.png",
        "/etc/passwd",
        "\\\\server\\share\\x.png",
        "C:\\x.png",
        "C:x.png",
        "images/C:/x.png",
        "..",
        "",
        "a\0b",
    ],
)
@pytest.mark.parametrize("field", ["file_path", "fg_mask_path", "mesh_path", "flame_param_path"])
def test_paths_that_leave_are_refused(tmp_path, path, field):
    """Catches path traversal: a downloaded capture must not read files elsewhere, on any operating
    system."""
    with refusal(rf"transforms\.json: frames\[0\]\.{field}: "):
        read_one(tmp_path, {**factory.frame(0, 0), field: path})


MALFORMED = """
file_path null, 3
timestep_index -1, 1.5, true, "3"
camera_index [1]
fl_x 0, NaN, "200"
fl_y -3.0
cx Infinity
cy {}
w 0, 1000000000
mesh_path ["a.obj"]
transform_matrix null, [[1, 0], [0]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [["a", 0, 0, 0]]
transform_matrix [[NaN, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
transform_matrix [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 2]]
transform_matrix [[1, 0.01, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
transform_matrix [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
transform_matrix [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
"""
"""Field, and values in JSON that it cannot have."""


@pytest.mark.parametrize("row", MALFORMED.strip().splitlines())
def test_malformed_fields(tmp_path, row):
    """Catches a wrong value that passes, or ends in a traceback, instead of an error that names
    file and field."""
    field, _, values = row.partition(" ")
    for value in json.loads(f"[{values}]"):
        with refusal(rf"transforms\.json: frames\[0\]\.{field}: "):
            read_one(tmp_path, {**factory.frame(0, 0), field: value})


@pytest.mark.parametrize("field", ["fl_x", "w", "timestep_index"])
def test_missing_fields_are_named(tmp_path, field):
    """Catches a frame without focal length, or without size and image, read as zeros, and one that
    silently becomes timestep 0 among others."""
    frames = [factory.frame(4, 0), factory.frame(4, 1)]
    del frames[1][field]
    with refusal(rf"frames\[1\]\.{field}: .*missing"):
        views_of(tmp_path, frames)
