"""Imported cameras against the capture's own projection; exported ones, opened as footage."""

import json
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from capture.factory import write_mesh_capture
from mathutils import Matrix, Vector
from numpy.random import default_rng
from numpy.testing import assert_allclose
from PIL import Image
from refusal import refusal

from stga_addon.capture.camera import camera_from_gl, look_at
from stga_addon.capture.model import View
from stga_addon.capture.open import open_capture
from stga_addon.scene import objects, tags
from stga_addon.scene.cameras import central, configure_scene, import_cameras
from stga_addon.scene.objects import capture_root, show_kind
from stga_addon.scene.rig.head import import_head
from stga_addon.tracking.footage.open import open_footage

from .captures import mesh_capture
from .session import failure, ops, viewport


def pose(seed):
    """Camera-to-world (4, 4), OpenGL axes: a meter from the origin, looking at it, rolled."""
    rng = default_rng(seed)
    back = rng.normal(size=3)
    back /= np.linalg.norm(back)
    right = np.cross(rng.normal(size=3), back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    matrix[:3, 3] = back + rng.normal(0, 0.02, 3)
    return matrix


def camera(seed=0, width=550, height=802, fl_y=2050.0):
    return camera_from_gl(pose(seed), (width, height), (2050.0, fl_y), (243.7, 431.9))


def capture_of(root, cameras):
    """cameras: index -> its camera at timesteps 3, 4, …; with an image for each."""
    views = []
    for index, row in cameras.items():
        for timestep, one in enumerate(row, start=3):
            name = f"images/{timestep:05d}_{index:02d}.png"
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (4, 4), (timestep, index, 0)).save(path)
            views.append(View(timestep, index, one, name, path))
    timesteps = sorted({view.timestep for view in views})
    split = {"train": tuple(views[::2]), "val": tuple(views[1::2])}
    return mesh_capture(root, timesteps=timesteps, views=split)


def assert_projects(camera_object, one, width=550, height=802):
    """Whether Blender puts points where the capture's camera does."""
    bpy.context.view_layer.update()
    points = default_rng(9).normal(0, 0.1, (50, 3))
    pixels, depths = one.project(points)
    # Captures are y up.
    world = [Vector((x, -z, y)) for x, y, z in points.tolist()]
    seen = [world_to_camera_view(bpy.context.scene, camera_object, point) for point in world]
    found = [(x * width, (1 - y) * height) for x, y, _ in seen]
    assert_allclose(found, pixels, atol=0.01, err_msg=camera_object.name)
    assert_allclose([depth for *_, depth in seen], depths, atol=1e-5)


@pytest.mark.parametrize("fl_y", [1900.0, 2300.0])
@pytest.mark.parametrize(("width", "height"), [(550, 802), (802, 550)])
def test_projection_equals_the_capture_s(tmp_path, width, height, fl_y):
    """Fails when a shift's sign or unit, the sensor's fit, or pixels' aspect is wrong."""
    one = camera(1, width, height, fl_y)
    capture = capture_of(tmp_path, {0: [one]})
    (imported,) = import_cameras(capture, capture_root(tmp_path))
    configure_scene(bpy.context.scene, capture, imported)
    assert_projects(imported, one, width, height)


def test_a_moving_camera_is_keyframed(tmp_path):
    """Fails when only the first pose is imported, or the camera tumbles between frames."""
    row = [camera(seed) for seed in (1, 2, 3)]
    capture = capture_of(tmp_path, {0: row})
    (imported,) = import_cameras(capture, capture_root(tmp_path))
    configure_scene(bpy.context.scene, capture, imported)
    turns = []
    for timestep, one in enumerate(row, start=3):
        bpy.context.scene.frame_set(timestep)
        assert_projects(imported, one)
        turns.append(np.array(imported.rotation_quaternion))
    assert min(turns[0] @ turns[1], turns[1] @ turns[2]) > 0


def test_background_images_follow_the_frame(tmp_path):
    """Fails when backgrounds are numbered by camera, or two are visible at once."""
    capture = capture_of(tmp_path, {5: [camera(0)] * 3, 8: [camera(1)] * 3})
    cameras = import_cameras(capture, capture_root(tmp_path))
    for frame, timestep in ((1, 3), (3, 3), (4, 4), (5, 5), (9, 5)):
        bpy.context.scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        for imported, index in zip(cameras, (5, 8), strict=True):
            backgrounds = imported.evaluated_get(depsgraph).data.background_images
            (shown,) = (each.image for each in backgrounds if each.show_background_image)
            assert Path(shown.filepath).name == f"{timestep:05d}_{index:02d}.png"
            assert imported.data.show_background_images


def test_problems_are_reported(tmp_path):
    """Fails when missing images or a zooming camera give no warning, or prevent the import."""
    capture = capture_of(tmp_path, {0: [camera(), camera(), replace(camera(), fl_x=1500.0)]})
    (tmp_path / "images" / "00004_00.png").unlink()
    said = []
    (imported,) = import_cameras(capture, capture_root(tmp_path), warn=said.append)
    assert len(imported.data.background_images) == 2
    intrinsics, missing = said
    assert "intrinsics" in intrinsics
    assert "00004_00.png" in missing


def test_the_parent_is_called_like_the_capture(tmp_path):
    """Catches a folder's name that is cut at a dot, as if it were a file's, and heads of all videos
    with the same name."""
    (tmp_path / "anna.v2").mkdir()
    assert capture_root(tmp_path / "anna.v2").name == "anna.v2"
    assert capture_root(tmp_path / "ben.v2.mp4").name == "ben.v2"
    assert capture_root(tmp_path / "clip 1 avatar 2/capture").name == "clip 1 2"
    assert capture_root(tmp_path / "demo/capture").name == "demo"


def test_second_import_replaces_the_first(tmp_path):
    """Fails when a second import keeps lost cameras, or their first poses."""
    root = capture_root(tmp_path)
    moving = capture_of(tmp_path, {0: [camera(0), camera(4)], 1: [camera(1)] * 2})
    first = import_cameras(moving, root)
    capture = capture_of(tmp_path, {0: [camera(2), camera(5)], 1: [camera(3)] * 2})
    assert import_cameras(capture, root) == first
    configure_scene(bpy.context.scene, capture, first[1])
    bpy.context.view_layer.update()
    assert_projects(first[1], camera(3))
    assert len(import_cameras(capture_of(tmp_path, {1: [camera(3)] * 2}), root)) == 1
    assert len(bpy.data.cameras) == 1


def test_scene_is_configured_on_request_only(tmp_path):
    """Fails when an import changes render settings, or configuring the scene misses one."""
    scene = bpy.context.scene
    scene.view_settings.view_transform = "AgX"
    before = (scene.render.resolution_x, scene.frame_start, scene.camera)
    capture = capture_of(tmp_path, {0: [camera()] * 3, 1: [camera(1, 400, 300)] * 3})
    capture = replace(capture, fps=30000 / 1001)
    cameras = import_cameras(capture, capture_root(tmp_path))
    assert before == (scene.render.resolution_x, scene.frame_start, scene.camera)
    assert scene.view_settings.view_transform == "AgX"
    said = []
    configure_scene(scene, capture, cameras[0], warn=said.append)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (550, 802)
    assert (scene.frame_start, scene.frame_end) == (3, 5)
    assert objects.frames_per_second(scene) == pytest.approx(30000 / 1001, rel=1e-6)
    assert scene.view_settings.view_transform == "Standard"
    assert scene.camera == cameras[0]
    assert len(said) == 1
    assert cameras[1].name in said[0]
    mine = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    with refusal("mine"):
        configure_scene(scene, capture, mine)


def test_looking_through_cameras_gives_the_resolution_back(extension, head):
    """Catches renders at a camera's size after it was looked through, and a size of the user's own
    that was chosen meanwhile, or after orbiting away, replaced."""
    render = bpy.context.scene.render
    window, area = viewport()
    view = area.spaces.active.region_3d

    def press(step=0):
        with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
            ops.view_footage(step=step)
        return render.resolution_x, render.resolution_y

    render.resolution_x = 1920
    render.resolution_y = 1080
    assert (press(), press(1), press()) == ((40, 60), (40, 60), (1920, 1080))
    press()
    view.view_perspective = "PERSP"  # orbited away
    assert (press(), press()) == ((40, 60), (1920, 1080))
    press()
    view.view_perspective = "PERSP"
    render.resolution_x = 1280
    assert (press(), press()) == ((40, 60), (1280, 60))
    press()
    render.resolution_x = 640
    assert press() == (640, 60)


def test_bones_and_cameras_are_in_collections_of_their_own(tmp_path):
    """Catches a head covered by cameras or hidden with them, and another central camera."""
    capture = open_capture(write_mesh_capture(tmp_path / "capture", range(2), range(3)))
    head = import_head(capture)
    cameras = import_cameras(capture, capture_root(capture.root))
    layer = bpy.context.view_layer
    show_kind(head.parent, tags.CAMERA, layer, False)
    assert head.visible_get()
    assert not any(camera.visible_get() for camera in cameras)
    assert objects.collection_of(head.parent, tags.CAMERA).name == f"{head.parent.name} cameras"
    assert [each.hide_viewport for each in objects.layers_of(head.parent, tags.CAMERA, layer)] == [
        True
    ]
    again = import_cameras(capture, capture_root(capture.root))
    assert again == cameras
    assert len(objects.collection_of(head.parent, tags.CAMERA).objects) == len(cameras)
    show_kind(head.parent, tags.CAMERA, layer, True)
    assert all(camera.visible_get() for camera in cameras)
    places = [(np.sin(angle), 0.0, np.cos(angle)) for angle in (0.9, -0.8, 0.1)]
    turned = {k: [look_at(p, (0, 0, 0), 40, 60, 80.0)] for k, p in enumerate(places)}
    around = import_cameras(capture_of(tmp_path, turned), capture_root(tmp_path))
    assert central(around) is around[2]
    assert central([]) is None


WIDTH = 64
HEIGHT = 48


def add_camera(name, position, **values):
    """A camera that looks at the origin."""
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
    render.resolution_x = 2 * WIDTH
    render.resolution_y = 2 * HEIGHT
    render.resolution_percentage = 50
    add_camera("left", (-1, -1, 0.3), lens=45, shift_x=0.1, shift_y=-0.05)
    add_camera("Camera.001", (0.2, -1.4, 0), lens=60, sensor_fit="VERTICAL", sensor_height=20)
    parent = bpy.data.objects.new("rail", None)
    bpy.context.collection.objects.link(parent)
    parent.scale = (2, 2, 2)
    parent.location = (0.1, 0, 0)
    add_camera("on rail", (0.6, -0.5, 0.1)).parent = parent
    bpy.context.view_layer.update()


@pytest.mark.usefixtures("extension")
def test_exported_cameras(tmp_path):
    """Catches shift, sensor fit, resolution or scale lost, and a camera written as another."""
    scene_with_cameras()
    assert ops.export_cameras(filepath=tmp_path / "transforms.json") == {"FINISHED"}
    for name in ("left", "Camera.001", "on rail"):
        for number in (1, 2):
            path = tmp_path / "images" / name / f"{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (WIDTH, HEIGHT)).save(path)
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["left", "Camera.001", "on rail"]
    assert footage.timesteps == (0, 1)
    assert footage.keeps_world
    for camera in footage.cameras:
        assert_projects(bpy.data.objects[camera.name], camera.camera, WIDTH, HEIGHT)
    left = bpy.data.objects["left"]
    path = tmp_path / "cameras.json"
    left.select_set(True)
    ops.export_cameras(filepath=path, selected_only=True)
    (frame,) = json.loads(path.read_text(encoding="utf-8"))["frames"]
    assert frame["camera_id"] == "left"
    left.select_set(False)
    none = {"filepath": tmp_path / "none.json", "selected_only": True}
    with failure("No cameras to export"):
        ops.export_cameras(**none)
    assert not (tmp_path / "none.json").exists()
    left.scale = -1, 1, 1
    with failure("left: is mirrored by a negative scale"):
        ops.export_cameras(filepath=path)
    left.scale = (1, 1, 1)
    left.data.type = "ORTHO"
    with failure("left: is not a perspective camera"):
        ops.export_cameras(filepath=path)
