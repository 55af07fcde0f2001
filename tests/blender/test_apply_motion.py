"""Apply Motion as a script calls it, and what leaves Blender again."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from capture.factory import ball, flame_parameters, write_flame_capture, write_mesh_capture
from gui.layouts import Layout
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.capture.open import open_capture
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.scene import tags
from stga_addon.scene.arrays import key_points
from stga_addon.scene.compat import action_curves, strip_curves
from stga_addon.scene.rig.head import rig_of
from stga_addon.training.optimize.avatar_tracking import RefinedTracking
from stga_addon.training.run.folder import with_refined_tracking, write_tracking

from .captures import mesh_at
from .session import failure, ops, panel, placed

pytestmark = pytest.mark.usefixtures("extension")
TOLERANCE = 2e-6
UNDRAWN = {"filepath", "source", "filter_glob", "is_open"}


class Reenacted:
    """A capture that is imported, and another person's motion in a file."""

    def __init__(self, folder):
        capture_folder, self.model_file = write_flame_capture(folder / "own")
        self.folder = capture_folder
        self.own = open_capture(capture_folder, self.model_file).flame
        ops.import_capture(directory=capture_folder, flame=self.model_file)
        rng = np.random.default_rng(5)
        self.other = {
            "expr": rng.normal(size=(5, 2)),
            "rotation": rng.normal(0, 0.5, (5, 3)),
            "neck_pose": rng.normal(0, 0.3, (5, 3)),
            "jaw_pose": rng.normal(0, 0.3, (5, 3)),
            "eyes_pose": rng.normal(0, 0.3, (5, 6)),
            "translation": rng.normal(0, 0.02, (5, 3)),
            "shape": rng.normal(0, 2, 4),
        }
        self.file = folder / "other.npz"
        np.savez(self.file, **self.other)

    def mesh(self, **values):
        return flame_forward(
            self.own.model, self.own.shape, FlameFrame(**values), self.own.static_offset
        )

    def theirs(self, row):
        return {name: value[row] for name, value in self.other.items() if name != "shape"}


@pytest.fixture
def scene(tmp_path):
    return Reenacted(tmp_path)


def write_refined(folder, capture, rng):
    """A run's file, whose parameters are disturbed."""
    tracking = RefinedTracking(capture, "stga")
    refined = tracking.parameters.copy()
    refined[:, :-3] += rng.normal(0, 0.05, tracking.tracked.shape)
    write_tracking(folder, tracking.sequence, refined, tracking.tracked)


@pytest.mark.parametrize("place", ["action", "strip"])
def test_refined_tracking_keeps_the_offsets_of_each_frame(tmp_path, place):
    """Catches a head that misses where its avatar was trained, also after another motion."""
    rng = np.random.default_rng(7)
    folder, model = write_flame_capture(tmp_path / "own")
    for path in (folder / "flame_param").glob("*.npz"):
        offset = rng.normal(0, 0.004, (1, len(ball()[0]), 3)).astype(np.float32)
        np.savez(path, **np.load(path), dynamic_offset=offset)
    ops.import_capture(directory=folder, flame=model)
    own = open_capture(folder, model)
    write_refined(tmp_path, own, rng)
    shown = with_refined_tracking(own, tmp_path)
    path = str(tmp_path / "tracking.npz")
    ops.apply_motion(filepath=path, start=0, place=place)
    assert np.abs(mesh_at(3) - shown.mesh(3)).max() > 1e-3  # as anybody's motion: without
    whole = {"place": place, "own_offsets": True, "blend": 0}
    ops.apply_motion(filepath=path, start=0, **whole)
    for timestep in own.timesteps:
        assert_allclose(mesh_at(timestep), shown.mesh(timestep), atol=2 * TOLERANCE)
    ops.apply_motion(filepath=path, start=10, speed=0.5, **whole)
    for timestep in own.timesteps:
        assert_allclose(mesh_at(10 + 2 * timestep), shown.mesh(timestep), atol=2 * TOLERANCE)


def drive(owner, path, source):
    curve = owner.driver_add(path, 0) if path.endswith("n") else owner.driver_add(path)
    variable = curve.driver.variables.new()
    variable.name = "x"
    variable.targets[0].id = source
    variable.targets[0].data_path = "location.x"
    curve.driver.expression = "x + 0.25"


def test_importing_again_keeps_the_shot(scene):
    """Catches camera, size, frame range, drivers or performance strips that another import of the
    same capture takes away, on either owner, once and twice, unused actions that pile up; a copy of
    a capture's camera, or one that was moved, put back; and a strip in tweak mode as an action."""
    ops.apply_motion(filepath=scene.file, start=12, place="strip")
    ops.apply_motion(filepath=scene.file, start=30, place="strip", jaw=False)
    shot = bpy.context.scene
    camera = bpy.data.objects.new("shot", bpy.data.cameras.new("shot"))
    shot.collection.objects.link(camera)
    shot.camera = camera
    shot.frame_end = 77
    shot.render.resolution_x = 999
    head = panel().head
    head.data.shape_keys.animation_data.nla_tracks[1].strips[0].influence = 0.5
    drive(head.data.shape_keys, 'key_blocks["expr_000"].value', camera)
    drive(rig_of(head), 'pose.bones["left_eye"].location', camera)
    drive(head, "pass_index", camera)
    times = (0, 1.5, 5, 12, 13.5, 17, 30, 33)
    before = [mesh_at(time) for time in times]
    moved, copied, still = tags.find(tags.CAMERA, scene.folder)
    flown = copied.copy()
    flown.name = "a flight"
    shot.collection.objects.link(flown)
    flown.keyframe_insert("location", frame=1)
    moved.location.x += 0.5
    moved.data.lens = 35.0
    kept = {each.name: (each.matrix_basis.copy(), each.data.lens) for each in (moved, flown)}
    tweaked = rig_of(head).animation_data
    tweaked.nla_tracks[-1].select = tweaked.nla_tracks[-1].strips[0].select = True
    tweaked.use_tweak_mode = True
    for _ in range(2):
        ops.import_capture(directory=scene.folder, flame=scene.model_file)
        for name, (matrix, lens) in kept.items():
            found = shot.objects[name]
            assert (found.matrix_basis, found.data.lens) == (matrix, lens)
        assert flown.animation_data.action is not None
        cameras = tags.find(tags.CAMERA, scene.folder)
        assert len(cameras) == 3
        assert still in cameras
        assert shot.camera == camera
        assert (shot.frame_end, shot.render.resolution_x) == (77, 999)
        for time, expected in zip(times, before, strict=True):
            assert_allclose(mesh_at(time), expected, atol=TOLERANCE)
    for owner in (rig_of(panel().head), panel().head.data.shape_keys):
        assert len(owner.animation_data.nla_tracks) == 4  # held, own, and two performances
    assert (
        head.animation_data.drivers.find("pass_index").driver.variables[0].targets[0].id == camera
    )
    ops.apply_motion(filepath=scene.file, start=0)
    before = [mesh_at(time) for time in times]
    actions = sorted(bpy.data.actions.keys())
    for _ in range(3):
        ops.import_capture(directory=scene.folder, flame=scene.model_file)
        for time, expected in zip(times, before, strict=True):
            assert_allclose(mesh_at(time), expected, atol=TOLERANCE)
    assert len(bpy.data.actions) <= len(actions) + 2, bpy.data.actions.keys()


def test_importing_again_keeps_what_was_made_by_hand(scene):
    """Catches an action or keyframes in the capture's own that are deleted silently, a shape
    key on a FLAME head, and a strip's influence, its interpolation, or a camera's focus that are
    reset."""
    head = panel().head
    rig = rig_of(head)
    keys = head.data.shape_keys
    fix = head.shape_key_add(name="fix", from_mix=False)
    fix.points[0].co.x += 0.1
    fix.value = 0.5
    camera = tags.find(tags.CAMERA, scene.folder)[0]
    camera.data.dof.use_dof = True
    ops.apply_motion(filepath=scene.file, start=12, place="strip")
    strip = rig.animation_data.nla_tracks[-1].strips[0]
    strip.use_animated_influence = True
    for place in ((12, 0.2), (16, 0.9)):
        point = strip.fcurves.find("influence").keyframe_points.insert(*place)
        point.interpolation = "CONSTANT"
    rig.pose.bones["jaw"].rotation_quaternion = (0.9, 0.4, 0, 0)
    rig.pose.bones["jaw"].keyframe_insert("rotation_quaternion", frame=40)
    rig.animation_data.action.name = "by hand"
    rig.animation_data.action_influence = 0.7
    edited = keys.animation_data.nla_tracks[1].strips[0]
    strip_curves(edited)[0].keyframe_points.insert(2, 1.5)
    name = edited.action.name
    times = (11, 13, 15, 40)
    before = [mesh_at(time) for time in times]
    for is_first in (True, False):
        ops.import_capture(directory=scene.folder, flame=scene.model_file)
        message = bpy.context.window_manager.stga_message
        assert ("made by hand" in message and message.endswith(f": {name}")) == is_first
        for time, expected in zip(times, before, strict=True):
            assert_allclose(mesh_at(time), expected, atol=TOLERANCE)
    assert bpy.data.actions[name].use_fake_user
    assert camera.data.dof.use_dof


def add_bones(rig):
    """As an artist adds them: one on the neck, which skins the mesh, and one that holds the
    root."""
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    bones = rig.data.edit_bones
    for name, parent in (("ear", "neck"), ("ring", "ear"), ("base", "")):
        added = bones.new(name)
        added.head = (0.1, 0.02, 0.0)
        added.tail = (0.15, 0.05, 0.02)
        added.roll = 0.3
        added.parent = bones.get(parent)
    top = next(name for name in ("root_joint", "root") if name in bones)
    bones[top].parent = bones["base"]
    bpy.ops.object.mode_set(mode="OBJECT")
    rig.data.collections.new("Extra").assign(rig.data.bones["ear"])
    rig.data.use_mirror_x = True
    head = panel().head
    head.vertex_groups.new(name="ear").add([3, 4, 5], 0.7, "REPLACE")
    ear = rig.pose.bones["ear"]
    ear.rotation_mode = "XYZ"
    for frame, turn in ((0, 0.0), (3, 0.8)):
        ear.rotation_euler.y = turn
        ear.keyframe_insert("rotation_euler", frame=frame)
    path = ear.path_from_id("rotation_euler")
    action_curves(rig).find(path, index=1).modifiers.new("CYCLES")
    rig.pose.bones["base"].location.z = 0.03
    rig.pose.bones["jaw"].custom_shape = placed("widget")


@pytest.mark.parametrize("as_strip", [False, True])
def test_importing_again_keeps_bones_and_keys_that_were_added(scene, as_strip):
    """Catches bones that an artist added to the rig lost, with what they move, their keyframes,
    pose, parents or collection; the shape by which an artist draws a bone; joints that two sides'
    mirroring displaces, and keyframes of an added shape key that no longer play."""
    head = panel().head
    rig = rig_of(head)
    add_bones(rig)
    fix = head.shape_key_add(name="fix", from_mix=False)
    fix.points[0].co.x += 0.1
    for frame, value in ((0, 0.0), (3, 1.0)):
        fix.value = value
        fix.keyframe_insert("value", frame=frame)
    if as_strip:
        ops.apply_motion(filepath=scene.file, start=12, place="strip")
    times = (0, 1.5, 3, 7.5, 13)

    names = sorted(bone.name for bone in rig.data.bones)
    before = {time: mesh_at(time) for time in times}
    posed = {}
    for time in times:
        mesh_at(time)
        posed[time] = {bone.name: np.array(bone.matrix) for bone in rig.pose.bones}
    assert np.abs(posed[0]["ring"] - posed[7.5]["ring"]).max() > 0.01
    for _ in range(2):
        ops.import_capture(directory=scene.folder, flame=scene.model_file)
        assert "made by hand" not in bpy.context.window_manager.stga_message
        assert sorted(bone.name for bone in rig.data.bones) == names
        assert rig.data.collections["Extra"].bones.keys() == ["ear"]
        assert rig.pose.bones["jaw"].custom_shape.name == "widget"
        assert rig.pose.bones["left_eye"].custom_shape.name == "STGA Bone"
        for time in times:
            assert_allclose(mesh_at(time), before[time], atol=TOLERANCE)
            for name, matrix in posed[time].items():
                assert_allclose(rig.pose.bones[name].matrix, matrix, atol=TOLERANCE)


def test_a_mesh_sequence_keeps_its_performances(tmp_path):
    """Catches performances, and the shapes that they move, which another import of the same
    capture takes away."""
    folder = write_mesh_capture(tmp_path / "capture")
    ops.import_capture(directory=folder)
    head = panel().head
    shape = head.shape_key_add(name="jawOpen", from_mix=False)
    shape.value = 0.0
    for point in shape.points:
        point.co.z -= 0.02
    table = "Timecode,BlendshapeCount,JawOpen\n00:00:00:00,1,0\n00:00:01:00,1,1\n"
    (tmp_path / "take.csv").write_text(table)
    times = (0, 1, 3, 20, 30, 40)
    for place in ("strip", "action"):
        ops.apply_motion(filepath=tmp_path / "take.csv", start=12, place=place, blend=0)
        before = [mesh_at(time) for time in times]
        assert np.abs(before[4] - before[5]).max() > 0.005
        neutral = key_points(panel().head.data.shape_keys.reference_key)
        if place == "strip":
            assert_allclose(mesh_at(70), neutral, atol=TOLERANCE)
        for _ in range(2):
            ops.import_capture(directory=folder)
            for time, expected in zip(times, before, strict=True):
                assert_allclose(mesh_at(time), expected, atol=TOLERANCE)


def test_the_capture_passes_into_the_neutral_face(scene):
    """Catches a face that jumps where its capture ends under performances, also after another
    import of the capture, and a capture that does not play as a whole."""
    last = max(scene.own.timesteps)
    own = [mesh_at(frame) for frame in scene.own.timesteps]
    ops.apply_motion(filepath=scene.file, start=40, place="strip", blend=6)
    for _ in range(2):
        for frame, expected in zip(scene.own.timesteps, own, strict=True):
            assert_allclose(mesh_at(frame), expected, atol=TOLERANCE)
        behind = np.stack([mesh_at(last + frame) for frame in range(8)])
        assert_array_equal(behind[6], behind[7])
        steps = np.abs(np.diff(behind[:7], axis=0)).max(axis=(1, 2))
        whole = np.abs(behind[6] - behind[0]).max()
        assert whole > 1e-3
        assert steps.max() < 0.3 * whole
        ops.import_capture(directory=scene.folder, flame=scene.model_file)


def test_the_head_is_neutral_beside_strips(scene):
    """Catches the capture's last grimace held beside performances, a head that jumps there, and one
    that is neutral where its capture plays."""
    last = max(scene.own.timesteps)
    own = [mesh_at(frame) for frame in scene.own.timesteps]
    ops.apply_motion(filepath=scene.file, start=20, place="strip", blend=0)
    for frame, expected in zip(scene.own.timesteps, own, strict=True):
        assert_allclose(mesh_at(frame), expected, atol=TOLERANCE)
    zero = np.zeros(3)
    tracked = vars(scene.own.frame(last))
    quiet = {"expr": np.zeros(2), "neck_pose": zero, "jaw_pose": zero, "eyes_pose": np.zeros(6)}
    for frame in (last + 5, 40):
        assert_allclose(mesh_at(frame), scene.mesh(**{**tracked, **quiet}), atol=TOLERANCE)
    assert_allclose(mesh_at(22), scene.mesh(**scene.theirs(2)), atol=TOLERANCE)


def test_undo(scene):
    """Catches a motion that undo leaves half of: actions, bindings, frame range."""
    actions = sorted(bpy.data.actions.keys())
    before = mesh_at(1)
    bpy.ops.ed.undo_push(message="before")
    ops.apply_motion(filepath=scene.file, start=1, place="strip", blend=0)
    bpy.ops.ed.undo_push(message="after")
    assert np.abs(mesh_at(1) - before).max() > 1e-3
    bpy.ops.ed.undo()
    assert sorted(bpy.data.actions.keys()) == actions
    assert not rig_of(panel().head).animation_data.nla_tracks
    assert_array_equal(mesh_at(1), before)


def test_a_file_its_parts_and_its_frames(scene):
    """Catches switches without effect, the other's identity, a shifted frame, and another speed."""
    chosen = {"jaw": False, "eyes": False, "neck": False, "head": False, "strength": 0.5}
    ops.apply_motion(filepath=scene.file, start=0, **chosen)
    own = vars(scene.own.frame(1)) | {"expr": scene.other["expr"][1] / 2}
    assert_allclose(mesh_at(1), scene.mesh(**own), atol=TOLERANCE)
    with failure("no part is chosen"):
        ops.apply_motion(filepath=scene.file, **chosen, expression=False)
    ops.apply_motion(filepath=scene.file, start=10)
    for row in range(5):
        assert_allclose(mesh_at(10 + row), scene.mesh(**scene.theirs(row)), atol=TOLERANCE)
    assert bpy.context.scene.frame_end == 14
    bpy.context.scene.render.fps = 24
    ops.apply_motion(filepath=scene.file, start=1, fps=48)
    for frame, row in ((1, 0), (2, 2), (3, 4)):
        assert_allclose(mesh_at(frame), scene.mesh(**scene.theirs(row)), atol=TOLERANCE)
    ops.apply_motion(filepath=scene.file, start=1, fps=48, speed=0.5)
    assert_allclose(mesh_at(4), scene.mesh(**scene.theirs(3)), atol=TOLERANCE)


def test_a_capture_and_another_head(scene, tmp_path):
    """Catches a folder not taken as a motion, and a hand-made animation that is not applied."""
    folder, model = write_flame_capture(tmp_path / "second", timesteps=(0, 1, 2))
    name = panel().head.name
    ops.apply_motion(filepath=folder, start=20)
    expected = {**vars(scene.own.frame(1)), **read_row(2)}
    assert_allclose(mesh_at(22), scene.mesh(**expected), atol=TOLERANCE)
    ops.import_capture(directory=folder, flame=model)
    second = panel().head
    rig_of(second).animation_data.action = None
    rig_of(second).pose.bones["neck"].rotation_quaternion = (np.cos(0.2), 0, np.sin(0.2), 0)
    rig_of(second).pose.bones["neck"].keyframe_insert("rotation_quaternion", frame=0)
    panel().head = bpy.data.objects[name]
    ops.apply_motion(source=second.name, start=40, head=False, jaw=False, eyes=False)
    # What is not taken stays: frame 42 lies behind the last keyframe of before, which holds.
    own = expected | {"expr": read_row(2)["expr"], "neck_pose": np.array([0, 0.4, 0])}
    assert_allclose(mesh_at(42), scene.mesh(**own), atol=TOLERANCE)


def read_row(timestep):
    fields = ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")
    arrays = flame_parameters(timestep)
    return {name: arrays[name][0].astype(np.float64) for name in fields}


def test_wrong_sources_change_nothing(scene, tmp_path):
    """Catches half a motion, and messages that do not say what is needed."""
    actions = sorted(bpy.data.actions.keys())
    before = mesh_at(1)
    np.savez(tmp_path / "wide.npz", expr=np.zeros((2, 50)))
    np.savez(tmp_path / "long.npz", expr=np.zeros((3, 2)))
    (tmp_path / "take.bvh").write_text("HIERARCHY\n")
    meshes = write_mesh_capture(tmp_path / "meshes")
    for arguments, message in (
        ({"filepath": tmp_path / "gone.npz"}, "gone.npz: does not exist"),
        ({"filepath": tmp_path / "take.bvh"}, "take.bvh: is no motion; expected .csv"),
        ({"filepath": scene.model_file}, "has none of expr"),
        ({"filepath": tmp_path / "wide.npz"}, "expr has shape"),
        ({"filepath": meshes}, "was not tracked with FLAME"),
        ({}, "no path given"),
        ({"source": "nobody"}, "nobody: is not an imported head"),
        ({"source": panel().head.name}, "is this head itself"),
        ({"filepath": tmp_path / "long.npz", "start": 1_048_573}, "Blender's last frame is"),
    ):
        with failure(message):
            ops.apply_motion(**arguments)
    assert sorted(bpy.data.actions.keys()) == actions
    assert_array_equal(mesh_at(1), before)
    scene.model_file.rename(tmp_path / "elsewhere.npz")
    with failure(r"model\.npz: cannot be read"):
        ops.apply_motion(filepath=scene.file)
    ops.import_capture(directory=meshes)
    needed = r"has no FLAME rig.*splats follow whatever moves its mesh"
    with failure(needed):
        ops.apply_motion(filepath=scene.file)


def test_the_dialog_shows_what_people_need(extension):
    """Catches a dialog of twenty-five options, and one that lacks any of them."""
    module = extension.operators.apply_motion
    operator = module.ApplyMotion
    names = {*operator.__annotations__, *module.MotionProperties.__annotations__}
    options = names - UNDRAWN
    for is_open, expected in ((False, 4), (True, len(options))):
        values = SimpleNamespace(layout=Layout(), is_open=is_open)
        operator.draw(values, bpy.context)
        leaves = values.layout.leaves
        shown = [leaf.arguments[1] for leaf in leaves if leaf.arguments[1] != "is_open"]
        assert len(shown) == expected
        assert set(shown) <= set(options)
