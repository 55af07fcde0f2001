"""Copies of avatars, and avatars on the bones of other armatures."""

import bpy
import numpy as np
import pytest

from stga_addon.avatar.file import Avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.scene import tags
from stga_addon.scene.arrays import evaluated_vertices, mesh_triangles, mesh_vertices
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import get_input, splat_modifier
from stga_addon.scene.rig.head import find_rig

from .session import failure, ops, panel


@pytest.fixture
def avatar(extension, demo, tmp_path):
    """A head with bones and splats."""
    ops.import_capture(directory=demo)
    head = panel().head
    neutral = mesh_vertices(head.data)
    faces = mesh_triangles(head.data)
    splats = lattice_splats(neutral, faces, sh_degree=1)
    write_avatar(tmp_path / "a.npz", Avatar(splats, "stga", neutral.astype(np.float32), faces))
    ops.show_avatar(filepath=tmp_path / "a.npz")
    return head


def world(head):
    bpy.context.view_layer.update()
    matrix = np.array(head.matrix_world)
    return evaluated_vertices(head) @ matrix[:3, :3].T + matrix[:3, 3]


def action(head):
    return head.data.shape_keys.animation_data.action


@pytest.mark.parametrize("linked", [False, True])
def test_a_copy_lives_by_itself(avatar, linked):
    """Catches a copy whose splats, drivers or bones are the original's, whose keyframes are shared
    or copied against what was asked for, that is not beside it, and data that nothing uses."""
    splats = panel().splats
    bpy.context.scene.collection.objects.link(find_rig(avatar))
    groups = set(bpy.data.node_groups)
    cameras = len(bpy.data.cameras)
    ops.duplicate_avatar(linked=linked)
    copy = panel().head
    assert copy != avatar
    assert copy.users_collection[0] != avatar.users_collection[0]
    assert (action(copy) == action(avatar)) == linked
    assert panel().splats != splats
    assert get_input(panel().splats, splat_nodes.HEAD) == copy
    neutral = [get_input(each, splat_nodes.NEUTRAL) for each in (splats, panel().splats)]
    assert neutral[0] != neutral[1]
    assert splat_modifier(panel().splats).node_group == splat_modifier(splats).node_group
    assert set(bpy.data.node_groups) == groups
    assert len(bpy.data.cameras) == cameras
    assert not bpy.data.libraries
    distance = world(copy).mean(0) - world(avatar).mean(0)
    for timestep in copy[tags.TIMESTEPS]:
        bpy.context.scene.frame_set(timestep)
        apart = world(copy) - world(avatar)
        np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-6)
    assert distance[0] > np.ptp(world(avatar)[:, 0])
    ops.duplicate_avatar(linked=linked)
    assert world(panel().head)[:, 0].min() > world(copy)[:, 0].max()
    before = world(avatar)
    rig = find_rig(copy)
    rig.animation_data_clear()
    jaw = rig.pose.bones["jaw"]
    jaw.rotation_mode = "XYZ"
    jaw.rotation_euler = (0.4, 0.0, 0.0)
    moved = world(copy)
    np.testing.assert_array_equal(world(avatar), before)
    assert np.abs(np.diff(moved - before, axis=0)).max() > 1e-3


def test_an_avatar_on_a_body(avatar):
    """Catches a head that jumps where it is attached, that does not follow the bone, or the other
    way round, and one that is not let go where it is."""
    data = bpy.data.armatures.new("body")
    body = bpy.data.objects.new("body", data)
    bpy.context.scene.collection.objects.link(body)
    bpy.context.view_layer.objects.active = body
    bpy.ops.object.mode_set(mode="EDIT")
    bone = data.edit_bones.new("spine")
    bone.head = (0.1, 0.0, -0.5)
    bone.tail = (0.1, 0.05, -0.2)
    bpy.ops.object.mode_set(mode="OBJECT")
    root = avatar.parent
    for frame in (0, 9):  # keyframes of the avatar's place stay
        root.keyframe_insert("location", frame=frame)
    before = world(avatar)
    with failure("spine.001: is no bone of body"):
        ops.attach_to_bone(armature="body", bone="spine.001")
    ops.attach_to_bone(armature="body", bone="spine")
    bpy.context.scene.frame_set(bpy.context.scene.frame_current)
    np.testing.assert_allclose(world(avatar), before, atol=1e-6)
    posed = body.pose.bones["spine"]
    rest = np.array(body.matrix_world @ posed.matrix)
    posed.rotation_mode = "XYZ"
    posed.rotation_euler = (0.3, 0.5, -0.2)
    bpy.context.view_layer.update()
    turn = np.array(body.matrix_world @ posed.matrix) @ np.linalg.inv(rest)
    expected = before @ turn[:3, :3].T + turn[:3, 3]
    np.testing.assert_allclose(world(avatar), expected, atol=1e-5)
    root.animation_data_clear()
    ops.attach_to_bone()
    np.testing.assert_allclose(world(avatar), expected, atol=1e-5)
    posed.rotation_euler = (0.0, 0.0, 0.0)
    np.testing.assert_allclose(world(avatar), expected, atol=1e-5)
    rig = find_rig(avatar)
    with failure("belongs to the avatar itself"):
        ops.attach_to_bone(armature=rig.name, bone=rig.data.bones[0].name)
    other = bpy.data.scenes.new("other")
    other.stga.head = avatar
    with failure("is not in the scene other"), bpy.context.temp_override(scene=other):
        ops.duplicate_avatar()


def test_the_panels_head_of_two_is_imported_again(avatar, demo):
    """Catches another import that replaces the original where the panel shows its copy."""
    ops.duplicate_avatar()
    copy = panel().head
    neutral = mesh_vertices(copy.data)
    for each in (avatar, copy):
        each.data.vertices[0].co = (9, 9, 9)
    ops.import_capture(directory=demo)
    assert panel().head == copy
    assert tuple(avatar.data.vertices[0].co) == (9, 9, 9)
    np.testing.assert_array_equal(mesh_vertices(copy.data), neutral)
    assert len(tags.heads_of(bpy.context.scene)) == 2
    assert copy.parent != avatar.parent
    splats = panel().splats
    assert get_input(splats, splat_nodes.HEAD) == copy
