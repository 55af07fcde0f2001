"""Another person's motion on a head, and a head's own motion read back, against FLAME's forward pass."""

import re
from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from stga_addon.errors import StgaError  # noqa: E402
from stga_addon.flame.forward import flame_forward  # noqa: E402
from stga_addon.flame.motion import PARTS, retimed  # noqa: E402
from stga_addon.flame.sequence import FlameSequence, sequence_mesh  # noqa: E402
from stga_addon.scene import compat  # noqa: E402
from stga_addon.scene.arrays import evaluated_vertices  # noqa: E402
from stga_addon.scene.compat import SLOTTED_ACTIONS  # noqa: E402
from stga_addon.scene.rig.flame_rig import rig_of  # noqa: E402
from stga_addon.scene.rig.head import import_head  # noqa: E402
from stga_addon.scene.rig.motion import apply_motion, sample_motion  # noqa: E402

from .captures import flame_model, flame_sequence, mesh_capture, motion_capture  # noqa: E402

TOLERANCE = 2e-6
FIELDS = ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")


@pytest.fixture
def own() -> FlameSequence:
    return flame_sequence(flame_model(), timesteps=range(1, 7), seed=1)


@pytest.fixture
def head(own, tmp_path):
    return import_head(motion_capture(own, tmp_path / "own.npz"))


@pytest.fixture
def other(own) -> FlameSequence:
    return flame_sequence(own.model, timesteps=range(4), seed=2)


def at_frame(head, frame: int) -> np.ndarray:
    bpy.context.scene.frame_set(frame)
    return evaluated_vertices(head)


def mesh(own: FlameSequence, frame) -> np.ndarray:
    return flame_forward(own.model, own.shape, frame, own.static_offset)


def owners(head) -> list:
    return [rig_of(head), head.data.shape_keys]


def curves_of(owner, action) -> dict:
    """(path, index) -> keyframes of an action, wherever this Blender keeps them."""
    if not SLOTTED_ACTIONS:
        found = action.fcurves
    else:
        found = [curve for bag in action.layers[0].strips[0].channelbags for curve in bag.fcurves]
    return {(c.data_path, c.array_index): [tuple(p.co) for p in c.keyframe_points] for c in found}


def test_the_other_moves_this_head(head, own, other):
    """Fails when the other's identity comes along, a frame is off, or a coefficient that was in use stays behind."""
    apply_motion(head, retimed(other), 11, "other")
    for index in range(4):
        expected = mesh(own, other.frame(index))
        np.testing.assert_allclose(at_frame(head, 11 + index), expected, atol=TOLERANCE)
    assert np.abs(expected - sequence_mesh(other, 3)).max() > 1e-3


@pytest.mark.parametrize("as_strip", [False, True])
@pytest.mark.parametrize("part", PARTS)
def test_one_part_leaves_the_others_their_own_animation(head, own, other, part, as_strip):
    """Fails when a part that was not asked for is taken along, frozen, or reset."""
    apply_motion(head, retimed(other), 2, "other", (part,), as_strip)
    for index in range(4):
        theirs = other.frame(index)
        frame = replace(own.frame(2 + index), **{name: getattr(theirs, name) for name in PARTS[part]})
        np.testing.assert_allclose(at_frame(head, 2 + index), mesh(own, frame), atol=TOLERANCE)


def test_the_old_action_stays_as_it_was(head, own, other, tmp_path):
    """Fails when applying edits the action in place, or the old one is gone once the file is saved and opened."""
    before = [
        (owner.animation_data.action.name, curves_of(owner, owner.animation_data.action)) for owner in owners(head)
    ]
    apply_motion(head, retimed(other), 2, "other")
    name = head.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    head = bpy.data.objects[name]
    for owner, (title, curves) in zip(owners(head), before, strict=True):
        assert owner.animation_data.action.name != title
        assert curves_of(owner, bpy.data.actions[title]) == curves
        owner.animation_data.action = bpy.data.actions[title]
        if SLOTTED_ACTIONS:
            owner.animation_data.action_slot = bpy.data.actions[title].slots[0]
    np.testing.assert_allclose(at_frame(head, 4), sequence_mesh(own, 4), atol=TOLERANCE)


def test_strips_lie_over_what_was_there(head, own, other):
    """Fails when a strip replaces its surroundings, or a second one the first."""
    apply_motion(head, retimed(other), 2, "once", as_strip=True)
    apply_motion(head, retimed(other), 4, "twice", as_strip=True)
    for frame, expected in ((1, own.frame(1)), (2, other.frame(0)), (4, other.frame(0)), (7, other.frame(3))):
        np.testing.assert_allclose(at_frame(head, frame), mesh(own, expected), atol=TOLERANCE)
    for owner in owners(head):
        assert [len(track.strips) for track in owner.animation_data.nla_tracks] == [1, 1, 1]
        assert owner.animation_data.action is None


def test_only_what_moves_gets_an_action(head, other):
    """Fails when empty actions and strips pile up on what the chosen part does not touch."""
    rig, keys = owners(head)
    own_action = keys.animation_data.action
    apply_motion(head, retimed(other), 2, "other", ("jaw",))
    assert keys.animation_data.action == own_action
    apply_motion(head, retimed(other), 2, "again", ("expression",), as_strip=True)
    assert not rig.animation_data.nla_tracks
    assert len(keys.animation_data.nla_tracks) == 2


def test_applying_to_a_head_that_nothing_animates(head, own, other):
    """Fails when there is no action to copy or push down."""
    for owner in owners(head):
        owner.animation_data.action = None
    apply_motion(head, retimed(other), 3, "other")
    np.testing.assert_allclose(at_frame(head, 5), mesh(own, other.frame(2)), atol=TOLERANCE)
    rig_of(head).animation_data_clear()
    head.data.shape_keys.animation_data.action = None
    apply_motion(head, retimed(other), 3, "again", ("head",), as_strip=True)


def test_tracked_offsets_do_not_ride_along(own, other, tmp_path):
    """Fails when the vertex offsets of the own frames deform the other's expressions."""
    tracked = flame_sequence(own.model, timesteps=range(1, 5), seed=1, dynamic=True)
    for as_strip in (False, True):
        head = import_head(motion_capture(tracked, tmp_path / "own.npz"), warn=lambda sentence: None)
        apply_motion(head, retimed(other), 2, "other", as_strip=as_strip)
        np.testing.assert_allclose(at_frame(head, 3), mesh(tracked, other.frame(1)), atol=TOLERANCE)


def test_what_cannot_take_a_motion_is_told_and_left_alone(head, other, tmp_path):
    """Fails when half a motion is written, or a head without a rig ends in a traceback."""
    rig = rig_of(head)
    rig.pose.bones["jaw"].rotation_mode = "XYZ"
    actions = len(bpy.data.actions)
    with pytest.raises(StgaError, match="rotation mode of bone jaw"):
        apply_motion(head, retimed(other), 1, "other")
    rig.pose.bones["jaw"].rotation_mode = "QUATERNION"
    compat.push_down_action(rig)
    rig.animation_data.nla_tracks[0].select = True
    rig.animation_data.nla_tracks[0].strips[0].select = True
    rig.animation_data.use_tweak_mode = True
    assert rig.animation_data.use_tweak_mode
    with pytest.raises(StgaError, match="leave tweak mode first"):
        apply_motion(head, retimed(other), 1, "other")
    rig.animation_data.use_tweak_mode = False
    head.shape_key_remove(head.data.shape_keys.key_blocks["expr_004"])
    with pytest.raises(StgaError, match="has no slider expr_004"):
        apply_motion(head, retimed(other), 1, "other")
    assert len(bpy.data.actions) == actions
    with pytest.raises(StgaError, match="has no FLAME rig"):
        apply_motion(import_head(mesh_capture(tmp_path / "mesh")), retimed(other), 1, "other")


def assert_same_motion(read: FlameSequence, frames: list) -> None:
    for index, frame in enumerate(frames):
        for name in FIELDS:
            np.testing.assert_allclose(getattr(read.frame(index), name), getattr(frame, name), atol=2e-6)


def test_a_performance_is_read_back(head, own):
    """Fails when a joint is read in another's space, or a translation without the joint's own movement."""
    said = []
    bpy.context.scene.frame_set(3)
    read = sample_motion(head, own, range(1, 7), warn=said.append)
    assert_same_motion(read, [own.frame(timestep) for timestep in own.timesteps])
    np.testing.assert_allclose(read.shape, own.shape)
    assert said == []
    assert bpy.context.scene.frame_current == 3


def test_a_performance_by_hand_is_read_back(head, own):
    """Fails when only keyframes count: unkeyed poses, constraints and identity sliders make the mesh too."""
    rig, keys = rig_of(head), head.data.shape_keys.key_blocks
    rig.animation_data.action = head.data.shape_keys.animation_data.action = None
    rig.pose.bones["neck"].rotation_quaternion = (0.9, 0.3, 0.1, 0.2)
    turned = bpy.data.objects.new("turned", None)
    turned.rotation_euler = (0.4, 0, 0)
    bpy.context.scene.collection.objects.link(turned)
    rig.pose.bones["jaw"].constraints.new("COPY_ROTATION").target = turned
    keys["identity_002"].value, keys["expr_001"].value = 1.5, -2.0
    said = []
    read = sample_motion(head, own, (1,), warn=said.append)
    assert read.shape[2] == pytest.approx(own.shape[2] + 1.5)
    # The constraint bypasses the bone's own rotation, which the correctives are driven by; all else is FLAME's.
    flat = replace(own.model, posedirs=np.zeros_like(own.model.posedirs))
    keys_off = [key for key in keys if key.name.startswith("pose_")]
    for key in keys_off:
        key.mute = True
    expected = flame_forward(flat, read.shape, read.frame(0), own.static_offset)
    np.testing.assert_allclose(at_frame(head, 1), expected, atol=1e-5)


def test_what_flame_cannot_say_is_told(head, own):
    """Fails when an export leaves out what an artist sculpted without a word."""
    key = head.shape_key_add(name="sculpted", from_mix=False)
    key.data[5].co.x += 0.01
    key.value = 1.0
    said = []
    sample_motion(head, own, (2,), warn=said.append)
    assert len(said) == 1
    assert re.search(r"by up to \d+\.\d mm", said[0])


def test_offsets_are_read_back(own, tmp_path):
    """Fails when tracked per-frame offsets are lost on the way out."""
    tracked = flame_sequence(own.model, timesteps=range(1, 5), seed=1, dynamic=True)
    head = import_head(motion_capture(tracked, tmp_path / "own.npz"), warn=lambda sentence: None)
    said = []
    read = sample_motion(head, tracked, range(1, 5), warn=said.append)
    for index, timestep in enumerate(tracked.timesteps):
        np.testing.assert_allclose(sequence_mesh(read, index), sequence_mesh(tracked, timestep), atol=1e-5)
    assert said == []
