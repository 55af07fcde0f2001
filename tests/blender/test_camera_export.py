"""Cameras of the scene, exported and opened as footage."""

import json

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from bpy_extras.object_utils import world_to_camera_view  # noqa: E402
from mathutils import Matrix, Vector  # noqa: E402
from PIL import Image  # noqa: E402

from stga_addon.tracking.footage.open import open_footage  # noqa: E402

pytestmark = pytest.mark.usefixtures("extension")

WIDTH, HEIGHT = 64, 48


def add_camera(name, position, **values):
    data = bpy.data.cameras.new(name)
    for key, value in values.items():
        setattr(data, key, value)
    camera = bpy.data.objects.new(name, data)
    bpy.context.collection.objects.link(camera)
    camera.rotation_mode = "QUATERNION"
    turn = Vector(position).to_track_quat("Z", "Y")
    camera.matrix_world = Matrix.LocRotScale(position, turn, None)
    return camera


def scene_with_cameras():
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = 2 * WIDTH, 2 * HEIGHT
    render.resolution_percentage = 50
    add_camera("left", (-1, -1, 0.3), lens=45, shift_x=0.1, shift_y=-0.05)
    add_camera("Camera.001", (0.2, -1.4, 0), lens=60, sensor_fit="VERTICAL", sensor_height=20)
    parent = bpy.data.objects.new("rail", None)
    bpy.context.collection.objects.link(parent)
    parent.scale, parent.location = (2, 2, 2), (0.1, 0, 0)
    add_camera("on rail", (0.6, -0.5, 0.1)).parent = parent
    bpy.context.view_layer.update()


def test_points_project_as_in_blender(tmp_path):
    """Catches lens shift, sensor fit, resolution or a scaled parent lost on the way."""
    scene_with_cameras()
    assert bpy.ops.stga.export_cameras(filepath=str(tmp_path / "transforms.json")) == {"FINISHED"}
    for name in ("left", "Camera.001", "on rail"):
        for number in (1, 2):
            path = tmp_path / "images" / name / f"{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (WIDTH, HEIGHT)).save(path)
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["left", "Camera.001", "on rail"]
    assert footage.timesteps == (0, 1)
    assert footage.keeps_world
    points = np.random.default_rng(2).normal(0, 0.1, (12, 3))
    for camera in footage.cameras:
        # captures are y up
        pixels, depths = camera.camera.project(points[:, [0, 2, 1]] * [1, 1, -1])
        scene, thing = bpy.context.scene, bpy.data.objects[camera.name]
        seen = [world_to_camera_view(scene, thing, Vector(point)) for point in points]
        expected = [(x * WIDTH, (1 - y) * HEIGHT) for x, y, _ in seen]
        np.testing.assert_allclose(pixels, expected, atol=2e-3, err_msg=camera.name)
        np.testing.assert_allclose(depths, [z for _, _, z in seen], atol=1e-5)


def test_selected_cameras(tmp_path):
    """Catches the option without an effect, and an export of nothing."""
    scene_with_cameras()
    bpy.data.objects["left"].select_set(True)
    path = tmp_path / "cameras.json"
    bpy.ops.stga.export_cameras(filepath=str(path), selected_only=True)
    (frame,) = json.loads(path.read_text(encoding="utf-8"))["frames"]
    assert frame["camera_id"] == "left"
    bpy.data.objects["left"].select_set(False)
    with pytest.raises(RuntimeError, match="No cameras to export"):
        bpy.ops.stga.export_cameras(filepath=str(tmp_path / "none.json"), selected_only=True)
    assert not (tmp_path / "none.json").exists()


def test_cameras_that_are_no_pinholes(tmp_path):
    """Catches a camera written as another than it is."""
    scene_with_cameras()
    left, path = bpy.data.objects["left"], str(tmp_path / "transforms.json")
    left.scale = -1, 1, 1
    with pytest.raises(RuntimeError, match="left: is mirrored by a negative scale"):
        bpy.ops.stga.export_cameras(filepath=path)
    left.scale, left.data.type = (1, 1, 1), "ORTHO"
    with pytest.raises(RuntimeError, match="left: is not a perspective camera"):
        bpy.ops.stga.export_cameras(filepath=path)
