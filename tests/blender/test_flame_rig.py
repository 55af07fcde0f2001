"""The FLAME rig against FLAME's own forward pass in float64."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from stga_addon.flame.forward import flame_forward
from stga_addon.flame.model import JOINTS
from stga_addon.flame.parts import flame_model as bundled_model
from stga_addon.flame.sequence import sequence_mesh
from stga_addon.scene import tags
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.rig.head import import_head, rig_of
from stga_addon.scene.rig.keyframes import Placement, is_of_parts
from stga_addon.scene.rig.motion import LivePose, apply_motion, mirror_pose, sample_motion

from .captures import at_frame, flame_model, flame_sequence, motion_capture
from .session import open_file, placed, save

TOLERANCE = 2e-6  # meters; float32 skinning of a head half a meter from its origin


@pytest.fixture
def source(tmp_path):
    return tmp_path / "motion.npz"


def assert_parity(head, sequence, atol=TOLERANCE):
    for timestep in sequence.timesteps:
        expected = sequence_mesh(sequence, timestep)
        assert_allclose(at_frame(head, timestep), expected, atol=atol)


def changed(sequence, change):
    """The sequence with other values in its frames."""

    def frame(timestep):
        whole = sequence.frame(timestep)
        return replace(whole, **change(whole))

    return replace(sequence, frame=frame)


def quaternion(axis_angle):
    angle = np.linalg.norm(axis_angle)
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) / angle * axis_angle)])


def test_poses_set_by_hand_equal_the_forward_pass(source):
    """Fails when only imported frames match: fixed joints, missing drivers, raw quaternions."""
    sequence = flame_sequence(flame_model())
    head = import_head(motion_capture(sequence, source))
    rig = rig_of(head)
    keys = head.data.shape_keys
    rig.animation_data.action = keys.animation_data.action = None
    wanted = sequence_frame = flame_sequence(sequence.model, seed=5).frame(4)
    for name, axis_angle in zip(JOINTS, sequence_frame.pose, strict=True):
        rig.pose.bones[name].rotation_quaternion = 1.7 * quaternion(axis_angle)
    rig.pose.bones["root"].location = wanted.translation
    for component, value in enumerate(wanted.expr):
        keys.key_blocks[f"expr_{component:03d}"].value = value
    bpy.context.view_layer.update()
    expected = flame_forward(sequence.model, sequence.shape, wanted, sequence.static_offset)
    assert_allclose(evaluated_vertices(head), expected, atol=TOLERANCE)


def test_small_rotations_and_offsets_do_not_snap(source):
    """Fails when new drivers keep default keyframes, which snap results below 1e-4."""
    small = changed(
        flame_sequence(flame_model()),
        lambda full: {
            "expr": full.expr * 0.02,
            "neck_pose": np.full(3, 5e-5),
            "jaw_pose": np.full(3, -5e-5),
        },
    )
    assert_parity(import_head(motion_capture(small, source)), small, 5e-7)


def test_correctives_of_moving_joints_only(source):
    """Fails when still joints get keys, drivers or helper bones, or rotating ones lose theirs."""
    sequence = flame_sequence(flame_model())
    poses = {"neck_pose": np.full(3, 1e-3), "eyes_pose": np.zeros(6)}
    still = changed(sequence, lambda full: poses)
    head = import_head(motion_capture(still, source), correctives="moving")
    names = [key.name for key in head.data.shape_keys.key_blocks if key.name.startswith("pose_")]
    assert len(names) == 9
    assert all(name.startswith("pose_jaw_") for name in names)
    driven = {curve.data_path for curve in head.data.shape_keys.animation_data.drivers}
    assert len(driven) == 9
    directions = sequence.model.posedirs.copy()
    directions[:, :, :9] = 0  # the neck's
    assert_parity(head, replace(still, model=replace(sequence.model, posedirs=directions)))
    assert_parity(import_head(motion_capture(still, source)), still)
    model = flame_model()
    model.shapedirs[model.j_regressor.any(axis=0)] = 0
    sequence = flame_sequence(model)
    head = import_head(motion_capture(sequence, source))
    assert [bone.name for bone in rig_of(head).data.bones] == list(JOINTS)
    assert not rig_of(head).animation_data.drivers
    assert {group.name for group in head.vertex_groups} == set(JOINTS)
    assert_parity(head, sequence)


def test_between_frames_the_head_turns_and_does_not_shrink(source):
    """Fails when a quaternion changes sign, so that the head runs through zero."""
    model = flame_model()
    sequence = flame_sequence(model, timesteps=range(12))

    def frame(timestep):
        still = replace(sequence.frame(0), expr=np.zeros(model.n_expression))
        # as trackers write it: jumps from π to -π
        wrapped = (0.6 * timestep + np.pi) % (2 * np.pi) - np.pi
        return replace(still, rotation=np.array([0, wrapped, 0]))

    turning = replace(sequence, frame=frame)
    head = import_head(motion_capture(turning, source))
    for timestep in range(11):
        halfway = replace(turning.frame(0), rotation=np.array([0, 0.6 * (timestep + 0.5), 0]))
        expected = flame_forward(model, turning.shape, halfway, turning.static_offset)
        assert_allclose(at_frame(head, timestep + 0.5), expected, atol=TOLERANCE)


def test_all_components_have_sliders(source):
    """Fails when another motion's component has no key, a slider runs far beyond what a face does,
    or clamps a motion beyond its range."""
    model = flame_model(identity=12)
    used = np.isin(np.arange(model.n_expression), [3, 17])
    sparse = changed(flame_sequence(model), lambda full: {"expr": full.expr * used})
    head = import_head(motion_capture(sparse, source))
    keys = [key for key in head.data.shape_keys.key_blocks if not key.name.startswith("pose_")]
    expected = [f"expr_{k:03d}" for k in range(model.n_expression)]
    expected += [f"identity_{k:03d}" for k in range(10)]
    assert [key.name for key in keys] == ["Basis", *expected]
    assert {(key.slider_min, key.slider_max) for key in keys[1:]} == {(-3, 3)}
    assert_parity(head, sparse)
    strong = changed(flame_sequence(model), lambda full: {"expr": np.full_like(full.expr, -7.0)})
    frames = [strong.frame(timestep) for timestep in strong.timesteps]
    apply_motion(head, frames, Placement(0, "strong"))
    bpy.context.scene.frame_set(0)
    blocks = head.data.shape_keys.key_blocks
    assert blocks["expr_003"].value == -7
    LivePose(head, rig_of(head)).set_frame(replace(frames[0], expr=-frames[0].expr))
    assert blocks["expr_003"].value == 7


def test_what_a_rig_cannot_hold_is_reported(source):
    """Fails when dynamic_offset is dropped, spares joints or outlives its import, another object
    becomes active, or clamping comes without warning."""
    active = bpy.context.view_layer.objects.active = placed("mine")
    sequence = flame_sequence(flame_model(), dynamic=True)
    said = []
    head = import_head(motion_capture(sequence, source), warn=said.append)
    assert_parity(head, sequence)
    plain = flame_sequence(sequence.model)
    assert_parity(import_head(motion_capture(plain, source)), plain)
    large = changed(plain, lambda full: {"expr": full.expr + 12 * np.eye(len(full.expr))[7]})
    import_head(motion_capture(large, source), warn=said.append)
    (sentence,) = said  # nothing is lost of dynamic offsets
    assert "expression 7" in sentence
    assert bpy.context.view_layer.objects.active == active


def test_a_saved_rig_shows_the_same(source, tmp_path, capfd):
    """Fails when a joint, corrective, weight, rotation or translation is not FLAME's, when drivers
    are scripts (refused from others) or cycles, and when anything does not survive saving."""
    sequence = flame_sequence(flame_model())
    regions = {"mouth": np.arange(len(sequence.model.faces)) % 3 == 0}
    head = import_head(replace(motion_capture(sequence, source), regions=regions))
    name = head.name
    for owner in (rig_of(head), head.data.shape_keys):
        assert owner.animation_data.drivers
        for curve in owner.animation_data.drivers:
            assert curve.driver.is_simple_expression
            assert curve.is_valid
    save(tmp_path / "rig.blend")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    open_file(tmp_path / "rig.blend")
    assert_parity(bpy.data.objects[name], sequence)
    assert "cycle" not in "".join(capfd.readouterr()).lower()
    assert tags.REGION_PREFIX + "mouth" in bpy.data.objects[name].data.attributes


def test_the_bundled_head_has_arkits_sliders(source):
    """Fails when the bundled head's keys have numbers, do not come back as its coefficients, or run
    beyond 0 to 1 and what was tracked."""
    sequence = flame_sequence(bundled_model(None))
    head = import_head(motion_capture(sequence, source))
    names = [key.name for key in head.data.shape_keys.key_blocks[1:]]
    # and none for correctives, which it has not
    expected = list(sequence.model.expression_names)
    assert [name for name in names if not name.startswith("identity_")] == expected
    assert_parity(head, sequence)
    sampled = sample_motion(head, sequence, sequence.timesteps)
    for number, timestep in enumerate(sequence.timesteps):
        found = sampled.frame(number).expr
        tracked = sequence.frame(timestep).expr
        assert_allclose(found, tracked, atol=1e-5)
    key = head.data.shape_keys.key_blocks["jawOpen"]
    assert is_of_parts(key.path_from_id("value"), ["expression"])
    assert not is_of_parts(key.path_from_id("value"), ["head", "jaw"])
    column = expected.index("jawOpen")
    tracked = [sequence.frame(timestep).expr[column] for timestep in sequence.timesteps]
    limits = min(0.0, *tracked), max(1.0, *tracked)
    assert (key.slider_min, key.slider_max) == pytest.approx(limits)


def test_a_mirrored_pose_is_the_mirror_image(source):
    """Catches eyes, brows or a neck that turn to the wrong side, and a pose that mirrored twice is
    another one."""
    sequence = flame_sequence(bundled_model(None))
    plain = replace(sequence, shape=0 * sequence.shape, static_offset=None)
    head = import_head(motion_capture(plain, source))
    rig = rig_of(head)
    for owner in (head.data.shape_keys, rig):
        owner.animation_data.action = None
    rng = np.random.default_rng(3)
    for bone in JOINTS:
        rig.pose.bones[bone].rotation_quaternion = quaternion(rng.normal(0, 0.2, 3))
    rig.pose.bones["root"].location = 0.05, 0.02, -0.03
    for key in head.data.shape_keys.key_blocks[1:]:
        key.value = rng.random() * (rng.random() < 0.4) * (not key.name.startswith("identity"))
    poses = []
    for _ in range(3):
        bpy.context.view_layer.update()
        poses.append(evaluated_vertices(head))
        assert mirror_pose(head, rig)
    first, mirrored, again = poses
    assert_allclose(again, first, atol=TOLERANCE)
    away = cKDTree(mirrored * [-1, 1, 1]).query(first)[0]
    # its vertices are not mirror images of each other, at the back by up to 7 mm
    assert np.median(away) < 1e-3
    assert away.max() < 8e-3
    assert np.median(cKDTree(mirrored).query(first)[0]) > 5e-3
