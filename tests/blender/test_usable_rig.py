"""Heads whose rig cannot be posed: every operator and panel says why, in the same sentence."""

import bpy
import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.scene import tags
from stga_addon.scene.arrays import mesh_vertices
from stga_addon.scene.rig.head import rig_of

from .captures import mesh_at
from .session import failure, import_flame, ops, panel, placed, reopen, save
from .test_operators import show_ball
from .test_panel import draw

pytestmark = pytest.mark.usefixtures("extension")
DEFECTS = {
    "must be Quaternion": lambda head, rig: setattr(rig.pose.bones["jaw"], "rotation_mode", "XYZ"),
    "has no parent": lambda head, rig: setattr(head, "parent", None),
    "has no bone jaw": lambda head, rig: setattr(rig.data.bones["jaw"], "name", "Kiefer"),
    "has lost its shape keys": lambda head, rig: head.shape_key_clear(),
    "has the parent body": lambda head, rig: setattr(head, "parent", placed("body")),
    "rig: has no parent": lambda head, rig: setattr(rig, "parent", None),
    "is in Rest Position": lambda head, rig: setattr(rig.data, "pose_position", "REST"),
}


@pytest.fixture
def flame_head(tmp_path):
    import_flame(tmp_path / "capture")
    return panel().head


@pytest.mark.parametrize("problem", DEFECTS)
def test_every_operator_says_why_a_rig_cannot_be_posed(extension, flame_head, tmp_path, problem):
    """Catches Drive Live that moves nothing, tracebacks and KeyErrors, panels that raise at every
    redraw, and an import that resets the head before it fails."""
    motion = next((tmp_path / "capture").rglob("*.npz"))
    rig = rig_of(flame_head)
    DEFECTS[problem](flame_head, rig)
    for operator in ("pose_head", "apply_motion", "drive_live", "measure_range"):
        with failure(problem):
            getattr(ops, operator)(**{"filepath": motion} if operator == "apply_motion" else {})
    assert any(problem in text for text in [" ".join(draw(extension))])
    if problem in ("has no parent", "has the parent body"):
        action = rig.animation_data.action
        with failure(problem):
            ops.import_capture(directory=tmp_path / "capture", flame=flame_head[tags.FLAME_MODEL])
        assert rig.animation_data.action == action


def bring_linked(file, names):
    """Link these collections of a file into an empty scene."""
    save(file)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(file), link=True) as (_, taken):
        taken.collections = names
    bpy.context.scene.collection.children.link(taken.collections[0])
    return taken.collections[0]


def test_linked_avatars_are_left_alone(head, tmp_path):
    """Catches a head shadow and relit colors that are gone after reopening, and a second avatar
    over a linked one."""
    show_ball(tmp_path / "avatar.npz")
    collection = bring_linked(tmp_path / "a.blend", [head.users_collection[0].name])
    settings = panel()
    settings.head = next(each for each in collection.objects if each.name.endswith(" head"))
    settings.splats = next(each for each in collection.objects if "stga_convention" in each)
    for operator in ("head_shadow", "relight_frame", "estimate_light", "make_exact"):
        with failure("linked from another file"):
            getattr(ops, operator)()
    with failure("shows an avatar already"):
        ops.show_avatar(filepath=tmp_path / "avatar.npz")


def test_an_overridden_head_keeps_what_is_done_to_it(flame_head, tmp_path):
    """Catches bones that a library override can pose by hand, and Pose the Head refuses; and what
    Blender does not save of an override, accepted: selections, keys for Solve Again, another
    import, wider sliders, another avatar, keyframes in a linked action and the run's folder."""
    name = flame_head.name
    show_ball(tmp_path / "avatar.npz", mesh_vertices(flame_head.data))
    collection = bring_linked(tmp_path / "a.blend", [flame_head.users_collection[0].name])
    override = collection.override_hierarchy_create(
        bpy.context.scene, bpy.context.view_layer, do_fully_editable=True
    )
    bpy.context.view_layer.update()
    head = next(each for each in override.all_objects if each.name == name)
    panel().head = head
    ops.pose_head()
    assert rig_of(head).mode == "POSE"
    bpy.ops.object.mode_set(mode="OBJECT")
    capture = {"directory": tmp_path / "capture", "flame": tmp_path / "capture" / "model.npz"}
    operators = {"select": {}, "mark_key": {}, "measure_range": {}, "import_capture": capture}
    for operator, options in operators.items():
        with failure("is overridden, and Blender would not save"):
            getattr(ops, operator)(**options)
    with failure("has its splats in another file"):
        ops.show_avatar(filepath=tmp_path / "avatar.npz")
    ops.save_pose(name="pose")
    with failure("has its keyframes in another file"):
        ops.apply_pose(pose="pose", keyframe=True)
    wide = tmp_path / "wide.npz"
    np.savez(wide, expr=np.full((3, 2), 6.0))
    with failure("expr_000 needs a wider range"):
        ops.apply_motion(filepath=wide)
    np.savez(wide, expr=np.full((3, 2), 2.5), jaw_pose=np.full((3, 3), 0.1))
    ops.apply_motion(filepath=wide)
    panel().run_folder = str(tmp_path / "run")
    moved = mesh_at(2)
    reopen(tmp_path / "shot.blend")
    assert bpy.path.abspath(panel().run_folder) == str(tmp_path / "run")
    assert_allclose(mesh_at(2), moved, atol=1e-6)
