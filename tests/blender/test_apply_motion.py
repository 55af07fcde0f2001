"""Apply Motion as a script calls it, and what leaves Blender again."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from capture.factory import ball, flame_parameters, write_flame_capture, write_mesh_capture  # noqa: E402

from stga_addon.avatar.embedding import face_frames, to_world  # noqa: E402
from stga_addon.avatar.file import Avatar, write_avatar  # noqa: E402
from stga_addon.avatar.lattice import lattice_splats  # noqa: E402
from stga_addon.capture.model import Capture  # noqa: E402
from stga_addon.capture.open import open_capture  # noqa: E402
from stga_addon.export.ply import read_ply  # noqa: E402
from stga_addon.flame.forward import FlameFrame, flame_forward  # noqa: E402
from stga_addon.flame.sequence import read_motion  # noqa: E402
from stga_addon.scene.arrays import evaluated_vertices  # noqa: E402
from stga_addon.scene.display.splat_object import evaluated_splats  # noqa: E402
from stga_addon.scene.rig.head import rig_of  # noqa: E402
from stga_addon.training.optimize.avatar_tracking import RefinedTracking  # noqa: E402
from stga_addon.training.run.folder import with_refined_tracking, write_tracking  # noqa: E402

pytestmark = pytest.mark.usefixtures("extension")
TOLERANCE = 2e-6


class Reenacted:
    """A capture that is imported, and another person's motion in a file."""

    def __init__(self, folder: Path) -> None:
        capture_folder, self.model_file = write_flame_capture(folder / "own")
        self.folder = capture_folder
        self.own = open_capture(capture_folder, self.model_file).flame
        bpy.ops.stga.import_capture(directory=str(capture_folder), flame=str(self.model_file))
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

    def mesh(self, **values: np.ndarray) -> np.ndarray:
        return flame_forward(
            self.own.model, self.own.shape, FlameFrame(**values), self.own.static_offset
        )

    def theirs(self, row: int) -> dict[str, np.ndarray]:
        return {name: value[row] for name, value in self.other.items() if name != "shape"}


@pytest.fixture
def scene(tmp_path) -> Reenacted:
    return Reenacted(tmp_path)


def the_head():
    return bpy.context.scene.stga.head


def at(frame: int) -> np.ndarray:
    bpy.context.scene.frame_set(frame)
    return evaluated_vertices(the_head())


def show_avatar(folder: Path, scene: Reenacted) -> Avatar:
    """Trained on this person: its neutral mesh is the one of the tracked identity."""
    faces = ball()[1].astype(np.int32)
    neutral = open_capture(scene.folder, scene.model_file).neutral
    avatar = Avatar(
        lattice_splats(neutral, faces, order=0), "stga", neutral.astype(np.float32), faces
    )
    write_avatar(folder / "a.npz", avatar)
    bpy.ops.stga.show_avatar(filepath=str(folder / "a.npz"))
    return avatar


def test_a_file_from_a_start_frame(scene):
    """Catches the other's identity, a shifted frame, and a scene that stops too early."""
    assert bpy.ops.stga.apply_motion(filepath=str(scene.file), start=10) == {"FINISHED"}
    for row in range(5):
        np.testing.assert_allclose(at(10 + row), scene.mesh(**scene.theirs(row)), atol=TOLERANCE)
    assert bpy.context.scene.frame_end == 14


def write_refined(folder: Path, capture: Capture, rng: np.random.Generator) -> None:
    """A run's file, whose parameters are disturbed."""
    tracking = RefinedTracking(capture, "stga")
    refined = tracking.parameters.copy()
    refined[:, :-3] += rng.normal(0, 0.05, tracking.tracked.shape)
    write_tracking(folder, tracking.sequence, refined, tracking.tracked)


def test_a_runs_refined_tracking(scene, tmp_path):
    """Catches a head that misses where its avatar was trained: timesteps 0, 1, 3, refined."""
    capture = open_capture(scene.folder, scene.model_file)
    write_refined(tmp_path, capture, np.random.default_rng(0))
    shown = with_refined_tracking(capture, tmp_path)
    assert np.abs(at(3) - shown.mesh(3)).max() > 1e-3
    assert bpy.ops.stga.apply_motion(filepath=str(tmp_path / "tracking.npz"), start=0) == {
        "FINISHED"
    }
    for timestep in scene.own.timesteps:
        np.testing.assert_allclose(at(timestep), shown.mesh(timestep), atol=TOLERANCE)


@pytest.mark.parametrize("place", ["action", "strip"])
def test_refined_tracking_keeps_the_offsets_of_each_frame(tmp_path, place):
    """Catches what was tracked beside parameters lost, also after another motion."""
    rng = np.random.default_rng(7)
    folder, model = write_flame_capture(tmp_path / "own")
    for path in (folder / "flame_param").glob("*.npz"):
        offset = rng.normal(0, 0.004, (1, len(ball()[0]), 3)).astype(np.float32)
        np.savez(path, **np.load(path), dynamic_offset=offset)
    bpy.ops.stga.import_capture(directory=str(folder), flame=str(model))
    own = open_capture(folder, model)
    write_refined(tmp_path, own, rng)
    shown = with_refined_tracking(own, tmp_path)
    path = str(tmp_path / "tracking.npz")
    bpy.ops.stga.apply_motion(filepath=path, start=0, place=place)
    assert np.abs(at(3) - shown.mesh(3)).max() > 1e-3  # as anybody's motion: without
    bpy.ops.stga.apply_motion(filepath=path, start=0, place=place, own_offsets=True)
    for timestep in own.timesteps:
        np.testing.assert_allclose(at(timestep), shown.mesh(timestep), atol=2 * TOLERANCE)
    bpy.ops.stga.apply_motion(filepath=path, start=10, speed=0.5, place=place, own_offsets=True)
    for timestep in own.timesteps:
        np.testing.assert_allclose(at(10 + 2 * timestep), shown.mesh(timestep), atol=2 * TOLERANCE)


def test_tooltips_say_whose_motion(extension):
    """Catches two buttons that differ but explain themselves alike, or not at all."""
    operator = extension.operators.apply_motion.ApplyMotion
    refined_tracking = operator.description(bpy.context, SimpleNamespace(own_offsets=True))
    assert "refined by training" in refined_tracking
    # Where this is empty, Blender shows the operator's own.
    assert operator.description(bpy.context, SimpleNamespace(own_offsets=False)) == ""
    own = bpy.ops.stga.apply_motion.get_rna_type().description
    assert "another person" in own
    assert "refined" not in own


def test_undo(scene):
    """Catches a motion that undo leaves half of: actions, bindings, frame range."""
    actions, before = sorted(bpy.data.actions.keys()), at(1)
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.stga.apply_motion(filepath=str(scene.file), start=1, place="strip")
    bpy.ops.ed.undo_push(message="after")
    assert np.abs(at(1) - before).max() > 1e-3
    bpy.ops.ed.undo()
    assert sorted(bpy.data.actions.keys()) == actions
    assert not rig_of(the_head()).animation_data.nla_tracks
    np.testing.assert_array_equal(at(1), before)


def test_parts_and_strength(scene):
    """Catches switches that are not wired to what they say."""
    chosen = {"jaw": False, "eyes": False, "neck": False, "head": False, "strength": 0.5}
    bpy.ops.stga.apply_motion(filepath=str(scene.file), start=0, **chosen)
    own = vars(scene.own.frame(1)) | {"expr": scene.other["expr"][1] / 2}
    np.testing.assert_allclose(at(1), scene.mesh(**own), atol=TOLERANCE)
    with pytest.raises(RuntimeError, match="no part is chosen"):
        bpy.ops.stga.apply_motion(filepath=str(scene.file), **chosen, expression=False)


def test_recorded_at_another_rate(scene):
    """Catches a recording of 48 images a second that plays at half its speed in a scene of 24."""
    bpy.context.scene.render.fps = 24
    bpy.ops.stga.apply_motion(filepath=str(scene.file), start=1, fps=48)
    for frame, row in ((1, 0), (2, 2), (3, 4)):
        np.testing.assert_allclose(at(frame), scene.mesh(**scene.theirs(row)), atol=TOLERANCE)
    bpy.ops.stga.apply_motion(filepath=str(scene.file), start=1, fps=48, speed=0.5)
    np.testing.assert_allclose(at(4), scene.mesh(**scene.theirs(3)), atol=TOLERANCE)


def test_a_capture_and_another_head(scene, tmp_path):
    """Catches a folder not taken as a motion, and a hand-made animation that is not applied."""
    folder, model = write_flame_capture(tmp_path / "second", timesteps=(0, 1, 2))
    name = the_head().name
    bpy.ops.stga.apply_motion(filepath=str(folder), start=20)
    expected = {**vars(scene.own.frame(1)), **read_row(2)}
    np.testing.assert_allclose(at(22), scene.mesh(**expected), atol=TOLERANCE)
    bpy.ops.stga.import_capture(directory=str(folder), flame=str(model))
    second = the_head()
    rig_of(second).animation_data.action = None
    rig_of(second).pose.bones["neck"].rotation_quaternion = (np.cos(0.2), 0, np.sin(0.2), 0)
    rig_of(second).pose.bones["neck"].keyframe_insert("rotation_quaternion", frame=0)
    bpy.context.scene.stga.head = bpy.data.objects[name]
    assert bpy.ops.stga.apply_motion(
        source=second.name, start=40, head=False, jaw=False, eyes=False
    ) == {"FINISHED"}
    # What is not taken stays: frame 42 lies behind the last keyframe of before, which holds.
    own = expected | {"expr": read_row(2)["expr"], "neck_pose": np.array([0, 0.4, 0])}
    np.testing.assert_allclose(at(42), scene.mesh(**own), atol=TOLERANCE)


def read_row(timestep: int) -> dict[str, np.ndarray]:
    fields = ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")
    arrays = flame_parameters(timestep)
    return {name: arrays[name][0].astype(np.float64) for name in fields}


def test_wrong_sources_change_nothing(scene, tmp_path):
    """Catches half a motion, and messages that do not say what is needed."""
    actions, before = sorted(bpy.data.actions.keys()), at(1)
    np.savez(tmp_path / "wide.npz", expr=np.zeros((2, 50)))
    np.savez(tmp_path / "long.npz", expr=np.zeros((3, 2)))
    meshes = write_mesh_capture(tmp_path / "meshes")
    wrong = {
        "gone.npz": ({"filepath": str(tmp_path / "gone.npz")}, "gone.npz"),
        "model": ({"filepath": str(scene.model_file)}, "has none of expr"),
        "too many coefficients": ({"filepath": str(tmp_path / "wide.npz")}, "expr has shape"),
        "not FLAME": ({"filepath": str(meshes)}, "was not tracked with FLAME"),
        "nothing": ({}, "no path given"),
        "no head": ({"source": "nobody"}, "nobody: is not an imported head"),
        "itself": ({"source": the_head().name}, "is this head itself"),
        "far": (
            {"filepath": str(tmp_path / "long.npz"), "start": 1_048_573},
            "Blender's last frame is",
        ),
    }
    for arguments, message in wrong.values():
        with pytest.raises(RuntimeError, match=message):
            bpy.ops.stga.apply_motion(**arguments)
    assert sorted(bpy.data.actions.keys()) == actions
    np.testing.assert_array_equal(at(1), before)
    scene.model_file.rename(tmp_path / "elsewhere.npz")
    with pytest.raises(RuntimeError, match=r"model\.npz: cannot be read"):
        bpy.ops.stga.apply_motion(filepath=str(scene.file))


def test_heads_without_a_rig_are_told_what_is_needed(tmp_path):
    """Catches an operator that starts on a head it cannot animate."""
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    with pytest.raises(
        RuntimeError, match=r"has no FLAME rig.*splats follow whatever moves its mesh"
    ):
        bpy.ops.stga.apply_motion(filepath=str(tmp_path / "other.npz"))


def test_splats_follow_what_is_keyframed_by_hand(scene, tmp_path):
    """Catches splats that sliders, bones and identity do not move at once."""
    avatar = show_avatar(tmp_path, scene)
    rig, keys = rig_of(the_head()), the_head().data.shape_keys.key_blocks
    rig.animation_data.action = the_head().data.shape_keys.animation_data.action = None
    for frame, amount in ((30, 0.0), (40, 1.0)):
        keys["expr_001"].value, keys["identity_000"].value = 2 * amount, 3 * amount
        keys["expr_001"].keyframe_insert("value", frame=frame)
        keys["identity_000"].keyframe_insert("value", frame=frame)
        rig.pose.bones["jaw"].rotation_quaternion = (
            np.cos(0.2 * amount),
            np.sin(0.2 * amount),
            0,
            0,
        )
        rig.pose.bones["jaw"].keyframe_insert("rotation_quaternion", frame=frame)
    bpy.context.scene.frame_set(40)
    frame = vars(scene.own.frame(0)) | {
        "expr": np.array([keys["expr_000"].value, 2.0]),
        "rotation": np.zeros(3),
    }
    frame |= {
        "jaw_pose": np.array([0.4, 0, 0]),
        "neck_pose": np.zeros(3),
        "translation": np.zeros(3),
    }
    shape = scene.own.shape + 3 * np.eye(4)[0]
    for bone in rig.pose.bones:
        if bone.name in ("root", "neck", "left_eye", "right_eye"):
            bone.matrix_basis.identity()
    expected = flame_forward(scene.own.model, shape, FlameFrame(**frame), scene.own.static_offset)
    xyz, _, scale = evaluated_splats(bpy.context.scene.stga.splats)
    posed = to_world(avatar.splats, face_frames(expected, avatar.faces, avatar.neutral))
    np.testing.assert_allclose(xyz, posed.xyz, atol=1e-5)
    # Canonical areas stay those of the person who was trained: another identity stretches the
    # splats with the skin.
    np.testing.assert_allclose(scale, np.exp(posed.log_scale), rtol=2e-3)


def test_exports_hold_what_plays_in_the_scene(scene, tmp_path):
    """Catches exports of the tracked frames where the head is animated otherwise."""
    avatar = show_avatar(tmp_path, scene)
    bpy.ops.stga.apply_motion(filepath=str(scene.file), start=3)
    the_head().data.shape_keys.key_blocks["identity_001"].value = 1.5
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 3, 7
    assert bpy.ops.stga.export_avatar(filepath=str(tmp_path / "plys"), format="ply-sequence") == {
        "FINISHED"
    }
    assert bpy.ops.stga.export_avatar(
        filepath=str(tmp_path / "pair"), format="gaussian-avatars"
    ) == {"FINISHED"}
    shape = scene.own.shape + 1.5 * np.eye(4)[1]
    pair = read_motion(tmp_path / "pair/flame_param.npz", scene.own.model)
    np.testing.assert_allclose(pair.shape, shape, atol=1e-6)
    for row in range(5):
        theirs = FlameFrame(**scene.theirs(row))
        expected = flame_forward(scene.own.model, shape, theirs, scene.own.static_offset)
        posed = to_world(avatar.splats, face_frames(expected, avatar.faces, avatar.neutral))
        np.testing.assert_allclose(
            read_ply(tmp_path / f"plys/{3 + row:05d}.ply").xyz, posed.xyz, atol=1e-5
        )
        for name in ("expr", "translation", "rotation", "jaw_pose", "neck_pose", "eyes_pose"):
            np.testing.assert_allclose(
                getattr(pair.frame(row), name), scene.theirs(row)[name], atol=1e-5
            )
