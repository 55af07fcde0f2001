"""Heads and splats that a scene hides: they move in exports, or a sentence says why not."""

import json

import bpy
import numpy as np
import pytest

from stga_addon.export.ply import read_ply
from stga_addon.scene.display.splat_object import splat_modifier
from stga_addon.scene.evaluation import HELPER
from stga_addon.scene.render.viewport_display import ENGINE
from stga_addon.scene.rig.motion import sample_motion

from .session import failure, import_flame, ops, panel, placed
from .test_operators import show_ball

pytestmark = pytest.mark.usefixtures("extension")


def uncheck(collection):
    bpy.context.view_layer.layer_collection.children[collection.name].exclude = True


HIDE = {
    "nothing": lambda splats, collection: None,
    "splats": lambda splats, collection: setattr(splats, "hide_viewport", True),
    "modifier": lambda splats, collection: setattr(splat_modifier(splats), "show_viewport", False),
    "deleted splats": lambda splats, collection: bpy.data.objects.remove(splats),
    "collection": lambda splats, collection: uncheck(collection),
    "collection's monitor": lambda splats, collection: setattr(collection, "hide_viewport", True),
}


@pytest.mark.parametrize("hides", HIDE)
def test_hidden_heads_move_in_exports(head, tmp_path, hides):
    """Catches a sequence of equal poses with "Exported", and what is left of keeping them moved."""
    show_ball(tmp_path / "avatar.npz")
    shown = panel().splats
    ops.export_avatar(filepath=tmp_path / "shown", format="ply-sequence")
    HIDE[hides](shown, head.users_collection[0])
    objects = set(bpy.data.objects.keys())
    ops.export_avatar(filepath=tmp_path / "hidden", format="ply-sequence")
    assert set(bpy.data.objects.keys()) == objects
    assert HELPER not in bpy.data.meshes
    expected, found = (
        [read_ply(path).xyz for path in sorted((tmp_path / name).glob("*.ply"))]
        for name in ("shown", "hidden")
    )
    assert np.ptp(expected, axis=0).max() > 0.001
    np.testing.assert_allclose(found, expected, atol=1e-6)
    splats = {"filepath": tmp_path / "splats", "format": "ply-sequence"}
    if hides in ("collection", "deleted splats"):  # which images leave out, too
        with failure("shows no splats"):
            ops.export_splats(**splats)
        return
    ops.export_splats(**splats)
    written = [read_ply(path).xyz for path in sorted((tmp_path / "splats").glob("*.ply"))]
    assert np.ptp(written, axis=0).max() > 0.001


def test_renders_of_a_head_that_stands_still_are_refused(head, tmp_path):
    """Catches one pose in all images of F12, because the modifier's camera is off."""
    show_ball(tmp_path / "avatar.npz")
    scene = bpy.context.scene
    scene.render.engine = ENGINE
    scene.render.filepath = str(tmp_path / "x.png")
    scene.render.resolution_x = scene.render.resolution_y = 16
    splat_modifier(panel().splats).show_render = False
    with failure("switched off, so its splats stand still; switch on its camera"):
        bpy.ops.render.render()


@pytest.mark.parametrize("hides", ["nothing", "collection", "collection's monitor"])
def test_hidden_cameras_and_bodies_are_where_they_are_animated(head, tmp_path, hides):
    """Catches cameras exported from where they were when they were hidden, and an avatar that jumps
    as soon as the body that it is attached to is shown."""
    scene = bpy.context.scene
    lane = bpy.data.collections.new("lane")
    scene.collection.children.link(lane)
    camera = placed("dolly", bpy.data.cameras.new("dolly"))
    body = placed("body", bpy.data.armatures.new("body"))
    bpy.context.view_layer.objects.active = body
    bpy.ops.object.mode_set(mode="EDIT")
    body.data.edit_bones.new("neck").tail = (0.1, 0.0, 1.0)
    bpy.ops.object.mode_set(mode="OBJECT")
    scene.frame_set(1)
    for each in (camera, body):
        lane.objects.link(each)
        scene.collection.objects.unlink(each)
        for frame in (1, 9):
            each.location.x = 10 * frame
            each.keyframe_insert("location", frame=frame)
    scene.frame_set(1)
    HIDE[hides](None, lane)
    scene.frame_set(9)
    ops.export_cameras(filepath=tmp_path / "transforms.json")
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    dolly = next(each for each in frames if each["camera_id"] == "dolly")
    assert dolly["transform_matrix"][0][3] == pytest.approx(90)
    place = head.parent.matrix_world.copy()
    ops.attach_to_bone(armature="body", bone="neck")
    lane.hide_viewport = bpy.context.view_layer.layer_collection.children["lane"].exclude = False
    scene.frame_set(9)
    np.testing.assert_allclose(head.parent.matrix_world, place, atol=1e-4)


def test_a_hidden_performer_is_sampled(extension, tmp_path):
    """Catches a performer in an unchecked collection whose motion is all zero."""
    import_flame(tmp_path / "capture")
    head = panel().head
    own = extension.operators.common.recorded_motion(head)
    before = sample_motion(head, own, range(4))
    uncheck(head.users_collection[0])
    warned = []
    after = sample_motion(head, own, range(4), warned.append)
    assert not warned
    for timestep in range(4):
        for name in ("neck_pose", "jaw_pose", "translation", "expr"):
            wanted = getattr(before.frame(timestep), name)
            np.testing.assert_allclose(getattr(after.frame(timestep), name), wanted, atol=1e-6)
    assert max(np.abs(before.frame(timestep).jaw_pose).max() for timestep in range(4)) > 0.01
