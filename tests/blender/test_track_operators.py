"""The Track panel's way: footage, worker, import, a head posed by hand, and solved again."""

import sys
from math import radians

import bpy
import numpy as np
from capture.factory import ball, write_mesh_capture
from flame.small_head import small_head
from mathutils import Quaternion
from numpy.testing import assert_allclose
from tracking.test_head_model import blender_head

from stga_addon.jobs.perform import perform_in_folder
from stga_addon.scene import tags
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.tracking.head_model import HeadModel, read_head_model

from .captures import mesh_at
from .session import failure, import_flame, open_file, ops, panel, save, viewport

HEAD = HeadModel(small_head(0), "flame")


def track(take, out, **more):
    paths = {"footage": "footage", "landmarks": "points", "model": "head.npz"}
    paths = {name: str(take / path) for name, path in paths.items()}
    paths |= {"directory": out, "mattes": "none"}
    return ops.track_footage(**paths | more, python=sys.executable)


def asked(extension, take, out):
    """Ask for the tracking of the take, without a worker."""
    jobs = extension.stga_addon.jobs
    wanted = jobs.track.Track(take / "footage", take / "head.npz", out, landmarks=take / "points")
    jobs.perform.write_request(jobs.perform.request_folder(out), wanted)


def look_through(cameras):
    """Catches a view without the image that it is compared with, or of another size."""
    window, area = viewport()
    with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
        bpy.context.scene.camera = cameras[4]
        ops.view_footage(step=1)
        assert bpy.context.scene.camera == cameras[0]
        space = area.spaces.active
        assert (space.region_3d.view_perspective, space.shading.show_xray) == ("CAMERA", True)
        assert cameras[0].data.show_background_images
        assert cameras[0].visible_get()  # else Blender draws no background
        ops.view_footage()
        assert (space.region_3d.view_perspective, space.shading.show_xray) == ("PERSP", False)


def test_the_whole_way_of_the_panel(extension, take, tmp_path, monkeypatch):
    """Catches a capture not imported, a lost pose, or a key that the solution misses."""
    monkeypatch.setenv("STGA_PYTHON", sys.executable)
    tracked = tmp_path / "capture"
    assert track(take, tracked) == {"FINISHED"}
    scene = bpy.context.scene
    settings = panel()
    head = settings.head
    assert list(head[tags.TIMESTEPS]) == [0, 1, 2, 3, 4]
    assert settings.tracking_capture == str(tracked)
    assert settings.tracking_shown
    cameras = extension.stga_addon.scene.tags.find(tags.CAMERA, tracked)
    cameras = sorted(cameras, key=lambda camera: camera[tags.CAMERA_INDEX])
    assert [len(camera.data.background_images) for camera in cameras] == [5] * 5
    look_through(cameras)
    before = {frame: mesh_at(frame) for frame in range(5)}

    scene.frame_set(1)
    rig = extension.stga_addon.scene.rig.head.rig_of(head)
    bone = rig.pose.bones["jaw"]
    bone.rotation_quaternion = bone.rotation_quaternion @ Quaternion((1, 0, 0), radians(12))
    head.data.shape_keys.key_blocks["expr_001"].value += 0.5
    bpy.context.view_layer.update()
    posed = evaluated_vertices(head)
    assert np.abs(posed - before[1]).max() > 0.003
    ops.mark_key()
    assert_allclose(mesh_at(4), before[4], atol=1e-6)  # a key is of its frame alone
    assert_allclose(mesh_at(1), posed, atol=2e-5)

    ops.solve_again()
    head = settings.head
    assert_allclose(mesh_at(1), posed, atol=5e-5)
    assert np.abs(mesh_at(2) - before[2]).max() > 1e-4  # without landmarks: it follows
    assert np.abs(mesh_at(2) - before[2]).max() < np.abs(posed - before[1]).max()
    assert list(extension.operators.track.tracking_keys(head)) == [1]

    scene.frame_set(1)
    ops.mark_key()
    ops.solve_again()
    for frame in range(5):
        assert_allclose(mesh_at(frame), before[frame], atol=2e-6)

    ops.dismiss(request="tracking")
    assert not (tracked / "job").exists()
    assert settings.tracking_capture == ""


def test_exported_shape_keys_as_head_model(extension, take, tmp_path):
    """Catches shape keys that are tracked in Blender's axes."""
    model = HEAD.model
    shapes = model.shapedirs[:, :, [0, -1]]
    blender_head(model.v_template, model.faces, ["identity 0", "smile"], shapes)
    assert ops.export_head_model.poll()
    ops.export_head_model(filepath=tmp_path / "exported.npz")
    found = read_head_model(tmp_path / "exported.npz").model
    assert_allclose(found.v_template, model.v_template, atol=1e-6)
    assert track(take, tmp_path / "capture", model=str(tmp_path / "exported.npz")) == {"FINISHED"}
    assert list(panel().head[tags.TIMESTEPS]) == [0, 1, 2, 3, 4]


def test_mistakes_are_one_sentence(extension, take, tmp_path):
    """Catches a traceback, a panel that waits, and another tracker's capture overwritten."""
    for more, expected in (
        ({"model": "/nowhere/head.npz"}, "/nowhere/head.npz: cannot be read"),
        ({"footage": "/nowhere"}, "/nowhere: does not exist"),
    ):
        with failure(expected):
            track(take, tmp_path / "tracked", **more)
    assert panel().head is None
    assert not ops.cancel.poll()
    assert ops.track_footage.poll()
    import_flame(tmp_path / "capture")
    assert not ops.solve_again.poll()


def test_what_was_tracked_meanwhile_is_imported(extension, take, tmp_path, monkeypatch):
    """Catches a result lost where Blender was closed, or its file saved, meanwhile."""
    out = tmp_path / "capture"
    settings = panel()
    asked(extension, take, out)
    settings.tracking_capture = str(out)
    save(tmp_path / "a.blend")
    perform_in_folder(out / "job")
    monkeypatch.setattr(extension.operators.timers, "has_timer", lambda: True)
    # bpy 5.0 crashes now and then where a thread works while it opens a file
    for part in (extension.operators.pose, extension.operators.import_capture):
        monkeypatch.setattr(part, "begin_sliders", lambda head: None)
    open_file(tmp_path / "a.blend")
    extension.operators.monitor.tick()
    assert list(panel().head[tags.TIMESTEPS]) == [0, 1, 2, 3, 4]
    assert panel().tracking_shown


def test_the_head_is_shown_while_it_is_tracked(extension, tmp_path):
    """Catches a default cube where the head is known already, a head for each picture, and one that
    stays inside the imported one."""
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)
    scene = bpy.context.scene
    capture = write_mesh_capture(tmp_path / "capture")
    vertices, faces = ball()
    show = extension.operators.results.show_tracked
    show(scene, capture, {})
    assert not scene.objects["Cube"].hide_render
    before = set(bpy.data.objects)
    for size in (1.0, 2.0):
        picture = {"vertices": size * vertices, "faces": faces}
        show(scene, capture, picture)
        (head,) = set(bpy.data.objects) - before
        found = np.array([head.matrix_world @ vertex.co for vertex in head.data.vertices])
        expected = size * vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        assert_allclose(found, expected, atol=1e-6)
    assert scene.objects["Cube"].hide_render
    name = head.name
    ops.import_capture(directory=capture)
    assert name not in bpy.data.objects
    show(scene, capture, picture)  # the last picture, read late
    assert name not in bpy.data.objects
