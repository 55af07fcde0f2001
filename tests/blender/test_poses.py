"""Poses in the asset browser, against FLAME's forward pass."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from mathutils import Quaternion
from numpy.testing import assert_allclose

from stga_addon.driving.performance import ARKIT_SHAPES
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.scene import compat
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.rig.head import rig_of
from stga_addon.scene.rig.poses import PRESETS, poses

from .captures import import_small_head
from .session import failure, ops, panel

pytestmark = pytest.mark.usefixtures("extension")
TOLERANCE_M = 1e-5


@pytest.fixture
def posed(tmp_path):
    """The small head, with keyframes only at frame 1; its mesh in a pose is known."""
    person = import_small_head(tmp_path, expr=np.zeros((1, 10)))
    bpy.context.scene.frame_set(1)
    zero = np.zeros(3)
    rest = FlameFrame(np.zeros(10), zero, zero, zero, zero, np.zeros(6))

    def mesh(expr=(), **changes):
        frame = replace(rest, expr=np.pad(expr, (0, 10 - len(expr))), **changes)
        return flame_forward(person.model, person.shape, frame)

    return mesh


def shown():
    bpy.context.view_layer.update()
    return evaluated_vertices(panel().head)


def turn(bone, *angles):
    angles = np.array(angles)
    size = np.linalg.norm(angles)
    axis = angles / size
    rig_of(panel().head).pose.bones[bone].rotation_quaternion = Quaternion(axis, size)


def rest():
    head = panel().head
    for key in head.data.shape_keys.key_blocks[1:]:
        key.value = 0.0
    for bone in rig_of(head).pose.bones:
        bone.rotation_quaternion = (1.0, 0.0, 0.0, 0.0)
    return head


def test_save_and_apply(posed):
    """Catches a pose that misses sliders or bones, is reached by another path, moves what is not in
    it, cannot be played by Blender itself, or is gone after undo or with the file."""
    head = rest()
    keys = head.data.shape_keys.key_blocks
    with failure("is at rest"):
        ops.save_pose(name="Nothing")
    keys["expr_001"].value = 0.8
    keys["identity_001"].value = 0.5
    turn("neck", 0.1, 0.3, 0.0)
    turn("jaw", 0.4, 0.0, 0.0)
    turn("root", 0.0, 0.5, 0.0)
    ops.save_pose(name="Hello")
    (action,) = poses()
    assert action.asset_data is not None
    rest()
    keys["expr_002"].value = -0.6
    before = shown()
    bpy.ops.ed.undo_push(message="before")
    ops.apply_pose(pose="Hello", strength=0.5)
    half = {"neck_pose": np.array([0.05, 0.15, 0]), "jaw_pose": np.array([0.2, 0, 0])}
    assert_allclose(shown(), posed([0, 0.4, -0.6], **half), atol=TOLERANCE_M)
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    assert_allclose(shown(), before, atol=1e-7)
    ops.apply_pose(pose="Hello")
    whole = {name: 2 * value for name, value in half.items()}
    assert_allclose(shown(), posed([0, 0.8, -0.6], **whole), atol=TOLERANCE_M)
    head = rest()
    (action,) = poses()
    rig = rig_of(head)
    slots = {each.identifier[:2]: each.identifier for each in getattr(action, "slots", ())}
    for owner, kind in ((rig, "OB"), (head.data.shape_keys, "KE")):
        compat.assign_action(owner.animation_data, action, slots.get(kind))
    bpy.context.scene.frame_set(7)
    assert_allclose(shown(), posed([0, 0.8], **whole), atol=TOLERANCE_M)


def test_poses_are_keyframed_where_asked(posed):
    """Catches a pose that the next frame takes back, keyframes that nobody asked for, and bones
    that spin between two poses that are near each other."""
    head = rest()
    turn("neck", 0.0, 0.3, 0.0)
    head.data.shape_keys.key_blocks["expr_001"].value = 0.8
    ops.save_pose(name="Turned")
    rest()
    bone = rig_of(head).pose.bones["neck"]
    bone.rotation_quaternion = -bone.rotation_quaternion
    bone.keyframe_insert("rotation_quaternion", frame=10)
    scene = bpy.context.scene
    scene.frame_set(20)
    ops.apply_pose(pose="Turned", keyframe=True)
    turned = {"neck_pose": np.array([0, 0.3, 0])}
    scene.frame_set(20)
    assert_allclose(shown(), posed([0, 0.8], **turned), atol=TOLERANCE_M)
    quaternions = []
    for frame in range(10, 21):
        scene.frame_set(frame)
        quaternions.append(np.array(bone.rotation_quaternion))
    assert (np.sum(np.array(quaternions[1:]) * quaternions[:-1], axis=1) > 0.9).all()


def test_what_comes_along(posed):
    """Catches a head with ARKit's sliders without Smile, Ah and Blink, or with two of each; a sound
    that keeps the one before, a smile that does not, and a right side that is left out."""
    assert not poses()
    with failure("Smile: is no pose of this file"):
        ops.apply_pose(pose="Smile")
    rest()
    turn("neck", 0.0, 0.3, 0.0)
    ops.save_pose(name="Look Left")
    for _ in range(2):
        ops.add_arkit_controls()
        assert [action.name for action in poses()] == sorted(["Look Left", *PRESETS])
    keys = rest().data.shape_keys.key_blocks
    for name in ("Blink", "Smile", "Oo", "Ah"):
        ops.apply_pose(pose=name)
    values = {name: keys[name].value for name in ARKIT_SHAPES}
    assert values["jawOpen"] == pytest.approx(0.6)
    assert values["mouthPucker"] == 0
    assert values["mouthSmileRight"] == values["mouthSmileLeft"] == pytest.approx(0.7)
    assert values["eyeBlinkRight"] == 1
    ops.apply_pose(pose="Neutral", strength=0.5)
    assert keys["jawOpen"].value == pytest.approx(0.3)
    ops.apply_pose(pose="Neutral")
    assert not any(keys[name].value for name in ARKIT_SHAPES)
    keys["jawOpen"].name = "gone"
    ops.apply_pose(pose="Ah")
    assert "jawOpen" in bpy.context.window_manager.stga_message
