"""Web pages of a FLAME head exported from Blender: sliders, motion and camera."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from export.web.web_data import posed_mesh, read_web_data
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.file import Avatar, read_avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.flame.model import JOINTS
from stga_addon.flame.sequence import neutral_mesh
from stga_addon.scene import tags
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.rig.head import rig_of

from .captures import import_small_head, mesh_at
from .session import ops, panel, save
from .test_operators import write_ball_run
from .test_splat_object import active_camera

BLENDER_TOLERANCE_M = 2e-4
"""What the file's blend shapes leave out, times their weights."""


def demo_head(tmp_path):
    """The small FLAME head in the scene, moving, with an avatar and a camera; its identity."""
    motion = {name: default_rng(1).normal(0, 0.05, (3, 3)) for name in ("rotation", "jaw_pose")}
    expressions = default_rng(2).normal(0, 0.5, (3, 10))
    flame = import_small_head(tmp_path, expr=expressions, **motion)
    active_camera((0.1, -1, 0.2)).rotation_euler = (1.5, 0, 0.1)
    neutral = neutral_mesh(flame)
    faces = flame.model.faces
    splats = lattice_splats(neutral, faces, sh_degree=0)
    avatar = Avatar(splats, "stga", neutral.astype(np.float32), faces)
    write_avatar(tmp_path / "anna.npz", avatar)
    ops.show_avatar(filepath=tmp_path / "anna.npz")
    return flame


def exported(folder, **options):
    path = folder / "anna.glb"
    ops.export_avatar(filepath=path, format="web", **options)
    return read_web_data(path.read_bytes())


def assert_plays(header, arrays):
    """The page's mesh is that of the scene's head at each frame."""
    scene = bpy.context.scene
    for index, frame in enumerate(range(scene.frame_start, scene.frame_end + 1)):
        moved = arrays["coefficients"][index], arrays["pose"][index]
        found = posed_mesh(header, arrays, *moved, index)
        assert np.abs(found - mesh_at(frame)).max() < BLENDER_TOLERANCE_M


def test_sliders_motion_and_camera(extension, tmp_path):
    """Catches another slider, joint, motion or camera, and blend shapes in a page without."""
    flame = demo_head(tmp_path)
    header, arrays = exported(tmp_path)
    names = [f"expr_{component:03d}" for component in range(flame.model.n_expression)]
    assert sorted(slider["name"] for slider in header["sliders"]) == names
    rng = default_rng(0)
    expressions = rng.normal(0, 0.7, flame.model.n_expression)
    pose = rng.normal(0, 0.2, (len(JOINTS), 3))
    turns = (pose[0], pose[1], pose[2], arrays["translation"][0], pose[3:].ravel())
    wanted = FlameFrame(expressions, *turns)
    expected = flame_forward(flame.model, flame.shape, wanted, flame.static_offset)
    found = posed_mesh(header, arrays, expressions, pose, 0)
    assert np.abs(found - expected).max() < BLENDER_TOLERANCE_M
    header, arrays = exported(tmp_path, motion_only=True)
    assert (header["sliders"], header["joints"]) == ([], ["root"])
    assert_plays(header, arrays)
    scene = bpy.context.scene
    head = scene.stga.head
    jaw = rig_of(head).pose.bones["jaw"]
    for frame, angle in ((0, 0.0), (5, 0.4)):
        jaw.rotation_quaternion = (np.cos(angle / 2), np.sin(angle / 2), 0, 0)
        jaw.keyframe_insert("rotation_quaternion", frame=frame)
        head.data.shape_keys.key_blocks["expr_003"].value = 2 * angle
        head.data.shape_keys.key_blocks["expr_003"].keyframe_insert("value", frame=frame)
    scene.frame_start = 1
    scene.frame_end = 5
    scene.render.fps = 24
    header, arrays = exported(tmp_path)
    assert (header["fps"], len(arrays["pose"])) == (24, 5)
    assert_plays(header, arrays)
    assert np.ptp(arrays["pose"][:, JOINTS.index("jaw"), 0]) > 0.2
    camera = np.reshape(header["views"][0]["world_to_camera"], (4, 4))
    head_to_camera = np.array(scene.camera.matrix_world.inverted() @ head.matrix_world)
    assert_allclose(camera, np.diag([1, -1, -1, 1]) @ head_to_camera, atol=1e-5)


def test_an_avatar_comes_back(extension, tmp_path):
    """Catches a head that comes back in another pose, place, rate or order of splats, joints that
    do not move with the sliders, and bones or sliders that importers of plain glTF do not see."""
    demo_head(tmp_path)
    scene = bpy.context.scene
    scene.render.fps = 30
    path = tmp_path / "anna.glb"
    ops.export_avatar(filepath=path, format="skinned-gltf")
    frames = range(scene.frame_start, scene.frame_end + 1)

    def meshes():
        return np.array([mesh_at(frame) for frame in frames])

    before = meshes()
    splats = read_avatar(tmp_path / "anna.npz").splats
    bpy.ops.wm.read_homefile(use_empty=True)
    ops.import_avatar(filepath=path)
    scene = bpy.context.scene
    frames = range(scene.frame_start, scene.frame_end + 1)
    assert scene.render.fps == 30
    assert np.abs(meshes() - before).max() < BLENDER_TOLERANCE_M
    found = read_avatar(tmp_path / "anna_avatar" / "avatar.npz").splats
    order = np.argsort(splats.face, kind="stable")
    assert_array_equal(found.face, splats.face[order])
    assert np.abs(found.xyz - splats.xyz[order]).max() < 3e-5
    assert len(scene.stga.splats.data.vertices) == len(found)
    assert scene.stga.avatar == str(tmp_path / "anna_avatar" / "avatar.npz")

    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    scene = bpy.context.scene
    head = next(thing for thing in scene.objects if getattr(thing.data, "shape_keys", None))
    [rig] = [thing for thing in scene.objects if thing.type == "ARMATURE"]
    assert {bone.name for bone in rig.data.bones} == set(JOINTS)
    names = [key.name for key in head.data.shape_keys.key_blocks]
    assert names == ["Basis", *(f"expr_{number:03d}" for number in range(len(names) - 1))]
    scene.frame_set(round(scene.render.fps / 30))
    corners = evaluated_vertices(head)
    assert np.ptp(corners, axis=0) == pytest.approx(np.ptp(before[1], axis=0)[[0, 2, 1]], abs=2e-3)


def test_an_avatar_without_sliders_comes_back(extension, tmp_path):
    """Catches a file of the motion alone that is refused for what it never had, or stands still."""
    demo_head(tmp_path)
    ops.export_avatar(filepath=tmp_path / "anna.glb", format="skinned-gltf", motion_only=True)
    frames = range(3)
    before = np.array([mesh_at(frame) for frame in frames])
    bpy.ops.wm.read_homefile(use_empty=True)
    ops.import_avatar(filepath=tmp_path / "anna.glb")
    found = np.array([mesh_at(frame) for frame in frames])
    assert np.abs(found - before).max() < BLENDER_TOLERANCE_M


def test_importing_an_avatar_overwrites_nothing(extension, tmp_path, monkeypatch):
    """Catches a trained run beside the file that gets its quantized copy, a second head by a second
    import, a file in a read-only folder that is refused, heads called "motion", a warning of FLAME
    masks, a performer of the head's name taken for the head, and half a head where parts of an
    earlier import are damaged."""
    demo_head(tmp_path)
    ops.export_avatar(filepath=tmp_path / "anna.glb", format="skinned-gltf")
    run = write_ball_run(tmp_path / "anna_avatar")
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    bpy.ops.wm.read_homefile(use_empty=True)
    manager = bpy.context.window_manager
    for _ in range(2):
        ops.import_avatar(filepath=tmp_path / "anna.glb")
        assert "mask" not in manager.stga_message
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before
    head = panel().head
    assert [each.name for each in bpy.data.objects if each.name.endswith("head")] == ["anna head"]
    assert panel().avatar == str(tmp_path / "anna_avatar_2/avatar.npz")
    save(tmp_path / "library.blend", copy=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, taken):
        taken.collections = ["anna"]
    bpy.context.scene.collection.children.link(taken.collections[0])
    performer = taken.collections[0].objects[head.name]
    assert performer != head
    ops.apply_motion(source=performer.name)

    kept = tmp_path / "user"
    kept.mkdir()
    make = Path.mkdir

    def refuse(path, *arguments, **options):
        if path.parent == tmp_path:
            raise PermissionError(13, "Permission denied")
        make(path, *arguments, **options)

    monkeypatch.setattr(Path, "mkdir", refuse)
    monkeypatch.setattr(bpy.utils, "user_resource", lambda kind, path: str(kept / path))
    (tmp_path / "anna.glb").rename(tmp_path / "ben.glb")
    ops.import_avatar(filepath=tmp_path / "ben.glb")
    assert panel().head.name == "ben head"
    assert Path(panel().head[tags.CAPTURE]).is_relative_to(kept)
    damaged = Path(panel().avatar)
    damaged.write_bytes(b"")
    bpy.ops.wm.read_homefile(use_empty=True)
    ops.import_avatar(filepath=tmp_path / "ben.glb")
    assert Path(panel().avatar) == kept / "stga_avatars/ben_avatar_2/avatar.npz"
