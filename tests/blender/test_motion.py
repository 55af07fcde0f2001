"""Motion applied to a head, and sampled from the scene, against FLAME's forward pass."""

import re
from dataclasses import replace

import bpy
import numpy as np
import pytest
from capture.factory import ball
from numpy.testing import assert_allclose
from refusal import refusal

from stga_addon.flame.forward import flame_forward
from stga_addon.flame.sequence import PARTS, retimed, sequence_mesh
from stga_addon.scene import compat
from stga_addon.scene.arrays import evaluated_vertices, head_vertices, triangle_mesh
from stga_addon.scene.compat import SLOTTED_ACTIONS
from stga_addon.scene.rig import keyframes
from stga_addon.scene.rig.head import import_head, rig_of
from stga_addon.scene.rig.keyframes import Placement
from stga_addon.scene.rig.motion import apply_motion, sample_motion

from .captures import at_frame, flame_model, flame_sequence, mesh_capture, motion_capture
from .session import placed, reopen

TOLERANCE = 2e-6
FIELDS = ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")


@pytest.fixture
def own():
    return flame_sequence(flame_model(), timesteps=range(1, 7), seed=1)


@pytest.fixture
def head(own, tmp_path):
    return import_head(motion_capture(own, tmp_path / "own.npz"))


@pytest.fixture
def other(own):
    return flame_sequence(own.model, timesteps=range(4), seed=2)


def mesh(own, frame):
    return flame_forward(own.model, own.shape, frame, own.static_offset)


def owners(head):
    return [rig_of(head), head.data.shape_keys]


def curves_of(owner, action):
    """(path, index) -> keyframes of an action, wherever this Blender keeps them."""
    if not SLOTTED_ACTIONS:
        found = action.fcurves
    else:
        found = [curve for bag in action.layers[0].strips[0].channelbags for curve in bag.fcurves]
    return {(c.data_path, c.array_index): [tuple(p.co) for p in c.keyframe_points] for c in found}


@pytest.mark.parametrize("as_strip", [False, True])
@pytest.mark.parametrize("part", PARTS)
def test_applying_one_part_keeps_the_other_parts(head, own, other, part, as_strip):
    """Fails when a part that was not chosen is replaced, frozen, or reset."""
    apply_motion(head, retimed(other), Placement(2, "other", (part,), as_strip))
    for index in range(4):
        theirs = {name: getattr(other.frame(index), name) for name in PARTS[part]}
        frame = replace(own.frame(2 + index), **theirs)
        assert_allclose(at_frame(head, 2 + index), mesh(own, frame), atol=TOLERANCE)


def test_the_old_action_is_unchanged(head, own, other, tmp_path):
    """Fails when the action is edited in place, or the old one is lost in the file."""
    actions = [(owner, owner.animation_data.action) for owner in owners(head)]
    before = [(action.name, curves_of(owner, action)) for owner, action in actions]
    apply_motion(head, retimed(other), Placement(2, "other"))
    name = head.name
    reopen(tmp_path / "a.blend")
    head = bpy.data.objects[name]
    for owner, (title, curves) in zip(owners(head), before, strict=True):
        assert owner.animation_data.action.name != title
        assert curves_of(owner, bpy.data.actions[title]) == curves
        owner.animation_data.action = bpy.data.actions[title]
        if SLOTTED_ACTIONS:
            owner.animation_data.action_slot = bpy.data.actions[title].slots[0]
    assert_allclose(at_frame(head, 4), sequence_mesh(own, 4), atol=TOLERANCE)


def test_strips_override_only_their_frames(head, own, other):
    """Fails when a strip changes frames outside it, or a second one removes the first."""
    apply_motion(head, retimed(other), Placement(2, "once", as_strip=True))
    apply_motion(head, retimed(other), Placement(4, "twice", as_strip=True))
    seen = {1: own.frame(1), 2: other.frame(0), 4: other.frame(0), 7: other.frame(3)}
    for frame, expected in seen.items():
        assert_allclose(at_frame(head, frame), mesh(own, expected), atol=TOLERANCE)
    for owner in owners(head):
        # the lowest one holds the neutral face, and the place of the head
        assert [len(track.strips) for track in owner.animation_data.nla_tracks] == [1, 1, 1, 1]
        assert owner.animation_data.action is None


@pytest.mark.parametrize(("second", "is_strip"), [(12, True), (8, True), (30, False)])
def test_strips_blend_where_they_overlap(head, own, second, is_strip):
    """Catches a neck or a slider that snaps where a strip begins or ends over another, or where a
    performance that was an action ends, and a blend on one of the two owners only."""
    rig = rig_of(head)
    smile = head.data.shape_keys.key_blocks["expr_000"]
    still = own.frame(1)
    for start, sign in ((1, 1.0), (second, -1.0)):
        neck = np.array((0.0, sign * 0.3, 0.0))
        frame = replace(still, neck_pose=neck, expr=np.eye(len(still.expr))[0] * sign)
        as_strip = is_strip or start == second
        apply_motion(head, [frame] * 16, Placement(start, str(start), as_strip=as_strip, blend=5.0))
    values = []
    for time in np.arange(7, second + 10, 0.5):  # the own motion ends at 6
        at_frame(head, time)
        bone = rig.evaluated_get(bpy.context.evaluated_depsgraph_get()).pose.bones["neck"]
        values.append((np.array(bone.matrix_basis.to_euler())[1] / 0.3, smile.value))
    steps = np.abs(np.diff(values, axis=0)).max(axis=0)
    assert steps.max() < 0.35, steps  # 2 where it snaps


def test_strips_blend_heads_that_are_upside_down(head, own):
    """Catches a spin between two strips in which the head is turned alike, by quaternions of
    opposite signs."""
    rig = rig_of(head)
    for start, angle in ((1, 3.0), (8, 3.1 - 2 * np.pi)):
        frame = replace(own.frame(1), rotation=np.array((angle, 0.0, 0.0)))
        apply_motion(head, [frame] * 16, Placement(start, str(start), ("head",), True, 3.0))
    for time in np.arange(7, 14, 0.25):
        at_frame(head, time)
        bone = rig.evaluated_get(bpy.context.evaluated_depsgraph_get()).pose.bones["root"]
        assert_allclose(bone.matrix_basis.to_3x3()[2][2], -1, atol=0.02)  # cos 3.05


def test_a_strip_keeps_the_animation_below_where_it_is(head, own, other):
    """Fails when keyframes between frames, or outside an action's manual range, are moved or lost
    below a strip."""
    rig = rig_of(head)
    rig.animation_data.action = None
    for frame, x in ((2.5, 0.1), (10.25, -0.2), (20.75, 0.4)):
        rig.pose.bones["root"].location.x = x
        rig.pose.bones["root"].keyframe_insert("location", frame=frame)
    rig.animation_data.action.use_frame_range = True
    rig.animation_data.action.frame_start = 4
    rig.animation_data.action.frame_end = 12.5
    times = (0.0, 2.5, 6.0, 10.25, 13.5, 25.0)
    before = [at_frame(head, time) for time in times]
    apply_motion(head, retimed(other), Placement(40, "other", ("jaw",), as_strip=True))
    for time, expected in zip(times, before, strict=True):
        assert_allclose(at_frame(head, time), expected, atol=TOLERANCE)


def test_moved_and_removed_sliders(head, own, other):
    """Fails when components are counted in Blender's list of shape keys, which users move, or the
    keyframes of a removed one end Mark as Key."""
    keys = head.data.shape_keys.key_blocks
    frames = [replace(frame, expr=frame.expr * (np.arange(30) != 4)) for frame in retimed(other)]
    head.shape_key_remove(keys["expr_004"])
    for name, way in (("expr_002", "BOTTOM"), ("expr_029", "UP"), ("expr_011", "TOP")):
        head.active_shape_key_index = keys.find(name)
        with bpy.context.temp_override(object=head):
            bpy.ops.object.shape_key_move(type=way)
    apply_motion(head, frames, Placement(20, "other"))
    for index, frame in enumerate(frames):
        assert_allclose(at_frame(head, 20 + index), mesh(own, frame), atol=TOLERANCE)
    keyframes.write_curves(head.data.shape_keys, 'key_blocks["expr_004"].value', [1, 9], [1, 2])
    bpy.context.view_layer.update()
    keys["expr_029"].value += 0.5
    posed = evaluated_vertices(head)
    keyframes.key_current_pose(head, rig_of(head), 23)
    assert_allclose(at_frame(head, 23), posed, atol=1e-5)
    assert np.abs(posed - mesh(own, frames[3])).max() > 1e-3


def test_applying_to_a_head_without_animation(head, own, other):
    """Fails without an action to copy, by another's identity, or with empty actions and strips."""
    for owner in owners(head):
        owner.animation_data.action = None
    apply_motion(head, retimed(other), Placement(3, "other"))
    for index in range(4):
        expected = mesh(own, other.frame(index))
        assert_allclose(at_frame(head, 3 + index), expected, atol=TOLERANCE)
    assert np.abs(expected - sequence_mesh(other, 3)).max() > 1e-3
    keys = head.data.shape_keys.animation_data
    action = keys.action
    apply_motion(head, retimed(other), Placement(3, "jaw", ("jaw",)))
    assert keys.action == action
    apply_motion(head, retimed(other), Placement(3, "strip", ("expression",), as_strip=True))
    assert not rig_of(head).animation_data.nla_tracks
    assert len(keys.nla_tracks) == 3  # the lowest one holds the neutral face
    rig_of(head).animation_data_clear()
    head.data.shape_keys.animation_data.action = None
    apply_motion(head, retimed(other), Placement(3, "again", ("head",), as_strip=True))


def test_unsuitable_rigs_are_refused_unchanged(head, other, tmp_path):
    """Fails when a motion is written in part, or the error is no StgaError."""
    rig = rig_of(head)
    rig.pose.bones["jaw"].rotation_mode = "XYZ"
    actions = len(bpy.data.actions)
    with refusal("rotation mode of bone jaw"):
        apply_motion(head, retimed(other), Placement(1, "other"))
    rig.pose.bones["jaw"].rotation_mode = "QUATERNION"
    compat.push_down_action(rig)
    rig.animation_data.nla_tracks[0].select = True
    rig.animation_data.nla_tracks[0].strips[0].select = True
    rig.animation_data.use_tweak_mode = True
    assert rig.animation_data.use_tweak_mode
    with refusal("leave tweak mode first"):
        apply_motion(head, retimed(other), Placement(1, "other"))
    rig.animation_data.use_tweak_mode = False
    head.shape_key_remove(head.data.shape_keys.key_blocks["expr_004"])
    with refusal("has no slider expr_004"):
        apply_motion(head, retimed(other), Placement(1, "other"))
    assert len(bpy.data.actions) == actions
    plain = import_head(mesh_capture(tmp_path / "mesh"))
    with refusal("has no FLAME rig"):
        apply_motion(plain, retimed(other), Placement(1, "other"))


def test_sampled_motion_equals_the_keyframes(head, own):
    """Fails when a rotation's space or the root's place is wrong, or sculpting goes unsaid."""
    said = []
    bpy.context.scene.frame_set(3)
    read = sample_motion(head, own, range(1, 7), warn=said.append)
    for index, frame in enumerate(map(own.frame, own.timesteps)):
        for name in FIELDS:
            found = getattr(read.frame(index), name)
            wanted = getattr(frame, name)
            assert_allclose(found, wanted, atol=2e-6)
    assert_allclose(read.shape, own.shape)
    assert said == []
    assert bpy.context.scene.frame_current == 3
    key = head.shape_key_add(name="sculpted", from_mix=False)
    key.data[5].co.x += 0.01
    key.value = 1.0
    said = []
    sample_motion(head, own, (2,), warn=said.append)
    assert len(said) == 1
    assert re.search(r"by up to \d+\.\d mm", said[0])


def test_a_head_with_modifiers_is_sampled(head, own):
    """Catches a traceback, or scattered vertices, where a modifier divides the head's triangles or
    makes others, and a subdivided head that is refused."""
    plain = head_vertices(head)
    divided = head.modifiers.new("divided", "SUBSURF")
    divided.subdivision_type = "SIMPLE"
    assert_allclose(head_vertices(head), plain, atol=1e-6)
    assert len(sample_motion(head, own, (4, 5)).timesteps) == 2
    head.modifiers.remove(divided)
    other = placed("ball", triangle_mesh("ball", *ball()))
    remeshed = other.modifiers.new("remeshed", "REMESH")
    for size in (0.003, 0.005, 0.01, 0.02):
        remeshed.voxel_size = size
        with refusal("its modifiers make other triangles"):
            head_vertices(other)
    other.modifiers.remove(remeshed)
    other.modifiers.new("decimated", "DECIMATE").ratio = 0.5
    with refusal("its modifiers make other triangles"):
        head_vertices(other)


def test_sampled_motion_includes_edits_by_hand(head, own):
    """Fails when poses without keyframes, constraints or identity sliders are ignored."""
    rig = rig_of(head)
    keys = head.data.shape_keys.key_blocks
    rig.animation_data.action = head.data.shape_keys.animation_data.action = None
    rig.pose.bones["neck"].rotation_quaternion = (0.9, 0.3, 0.1, 0.2)
    turned = placed("turned", None)
    turned.rotation_euler = (0.4, 0, 0)
    rig.pose.bones["jaw"].constraints.new("COPY_ROTATION").target = turned
    keys["identity_002"].value = 1.5
    keys["expr_001"].value = -2.0
    said = []
    read = sample_motion(head, own, (1,), warn=said.append)
    assert read.shape[2] == pytest.approx(own.shape[2] + 1.5)
    # The constraint bypasses the bone's own rotation, which the correctives are driven by; all else
    # is FLAME's.
    flat = replace(own.model, posedirs=np.zeros_like(own.model.posedirs))
    keys_off = [key for key in keys if key.name.startswith("pose_")]
    for key in keys_off:
        key.mute = True
    expected = flame_forward(flat, read.shape, read.frame(0), own.static_offset)
    assert_allclose(at_frame(head, 1), expected, atol=1e-5)


def test_tracked_offsets(own, other, tmp_path):
    """Fails when tracked offsets are missing from a sampled motion, or deform another's."""
    tracked = flame_sequence(own.model, timesteps=range(1, 5), seed=1, dynamic=True)
    head = import_head(motion_capture(tracked, tmp_path / "own.npz"), warn=lambda sentence: None)
    said = []
    read = sample_motion(head, tracked, range(1, 5), warn=said.append)
    for index, timestep in enumerate(tracked.timesteps):
        expected = sequence_mesh(tracked, timestep)
        assert_allclose(sequence_mesh(read, index), expected, atol=1e-5)
    assert said == []
    for as_strip in (False, True):
        apply_motion(head, retimed(other), Placement(2, "other", as_strip=as_strip))
        assert_allclose(at_frame(head, 3), mesh(tracked, other.frame(1)), atol=TOLERANCE)
