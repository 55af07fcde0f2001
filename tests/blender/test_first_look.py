"""What an imported capture looks like: framed viewports, bones that are posed by one button."""

import bpy
import numpy as np
import pytest
from capture.factory import write_mesh_capture
from mathutils import Vector
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.development.demo.capture import unpack_capture
from stga_addon.export.ply import write_ply
from stga_addon.scene import compat, tags
from stga_addon.scene.avatar_scene import frame_head
from stga_addon.scene.display.lit_nodes import LIGHTS
from stga_addon.scene.display.splat_nodes import AS_TRAINED, DISPLAY, LIMITS, NATIVE, POINTS, QUADS
from stga_addon.scene.display.splat_object import display_mode, set_input, splat_modifier
from stga_addon.scene.objects import layers_of

from .session import failure, import_flame, ops, panel, picture
from .test_operators import show_ball, write_ball_avatar
from .test_panel import draw


@pytest.fixture
def head(extension, tmp_path):
    import_flame(tmp_path / "capture")
    return panel().head


def viewports():
    areas = [area for screen in bpy.data.screens for area in screen.areas]
    return [area.spaces.active for area in areas if area.type == "VIEW_3D"]


def test_viewports_look_at_the_head(head):
    """Catches a view from the side, past the head, or one that shows it as a dot."""
    frame_head(head, bpy.context.scene.camera, bpy.data.screens)
    center = head.matrix_world @ (sum((Vector(corner) for corner in head.bound_box), Vector()) / 8)
    size = max(head.dimensions)
    assert viewports()
    for space in viewports():
        region = space.region_3d
        assert (region.view_location - center).length < 0.3 * size
        assert 0.5 * size < region.view_distance < 5 * size
        expected = np.array(bpy.context.scene.camera.matrix_world.to_3x3().normalized())
        assert_allclose(np.array(region.view_rotation.to_matrix()), expected, atol=1e-5)


def test_a_world_is_hidden_until_it_is_wanted(extension, tmp_path):
    """Catches a wall that covers the scene or lies down, and a second one."""
    ops.import_capture(directory=write_mesh_capture(tmp_path / "capture"))
    avatar = write_ball_avatar(tmp_path / "avatar.npz")
    write_ply(tmp_path / "world.ply", avatar.splats)
    for _ in range(2):
        ops.show_avatar(filepath=tmp_path / "avatar.npz")
    (world,) = [thing for thing in bpy.data.objects if thing.get(tags.WORLD)]
    head = panel().head
    bpy.context.view_layer.update()
    assert world.hide_get()
    assert world.hide_render
    assert panel().splats is not world
    assert_allclose(np.array(world.matrix_world), np.array(head.matrix_world), atol=1e-6)
    assert len(world.data.vertices) == len(avatar.splats)


@pytest.mark.parametrize("moved", [False, True])
def test_the_start_up_cube_does_not_enclose_the_head(extension, tmp_path, moved):
    """Catches a first look from within the default cube, and an artist's cube hidden."""
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    folder = str(write_mesh_capture(tmp_path / "capture"))
    cube.location.x = float(moved)
    bpy.context.view_layer.update()
    ops.import_capture(directory=folder)
    assert (cube.name, cube.hide_get(), cube.hide_render) == ("Cube", not moved, not moved)
    cube.hide_set(False)
    cube.hide_render = False
    ops.import_capture(directory=folder)
    assert (cube.hide_get(), cube.hide_render) == (False, False)


def test_pose_the_jaw_and_back(head, tmp_path):
    """Catches hidden bones, another bone selected, no way back, and a traceback without a rig."""
    layer = bpy.context.view_layer
    (bones,) = layers_of(head.parent, tags.RIG, layer)
    assert bones.hide_viewport
    ops.pose_head()
    rig = layer.objects.active
    assert (rig.get(tags.KIND), rig.mode, bones.hide_viewport) == (tags.RIG, "POSE", False)
    owners = rig.pose.bones if bpy.app.version >= (5, 0, 0) else rig.data.bones
    assert [bone.name for bone in owners if bone.select] == ["jaw"]
    assert rig.data.bones.active.name == "jaw"
    ops.pose_head()
    assert (rig.mode, bones.hide_viewport) == ("OBJECT", True)
    unpack_capture(tmp_path / "bundled")
    ops.import_capture(directory=tmp_path / "bundled")
    ops.pose_head()
    assert bpy.context.view_layer.objects.active.data.bones.active.name == "neck"
    ops.import_capture(directory=write_mesh_capture(tmp_path / "ball"))
    with failure("poll"):
        ops.pose_head()


def test_images_by_other_engines(extension, tmp_path):
    """Catches a missing avatar, points, quads edge-on, and limits changed needlessly."""
    ops.import_capture(directory=write_mesh_capture(tmp_path / "capture"))
    show_ball(tmp_path / "avatar.npz")
    shown = panel().splats
    scene = bpy.context.scene
    images = {}
    for mode in (AS_TRAINED, QUADS, POINTS):
        set_input(shown, DISPLAY, mode)
        images[mode] = picture(tmp_path / "image.png", "CYCLES")
    assert images[QUADS][..., :3].max() > 50
    assert_array_equal(images[AS_TRAINED], images[QUADS])
    assert np.abs(images[AS_TRAINED] - images[POINTS]).max() > 20
    scene = bpy.context.scene
    cycles = bpy.context.scene.cycles
    other = bpy.data.scenes.new("other").cycles
    assert (cycles.transparent_max_bounces, cycles.min_transparent_bounces) == (64, 64)
    assert other.transparent_max_bounces < 64
    cycles.transparent_max_bounces = 200
    cycles.min_transparent_bounces = 8
    ops.show_avatar(filepath=tmp_path / "avatar.npz")
    assert (cycles.transparent_max_bounces, cycles.min_transparent_bounces) == (200, 64)
    shown = scene.stga.splats
    scene.render.engine = "CYCLES"
    cycles.transparent_max_bounces = 8
    set_input(shown, DISPLAY, AS_TRAINED)
    ops.preview_images()
    assert compat.NATIVE_SPLATS or scene.eevee.taa_samples == 4
    best = NATIVE if compat.NATIVE_SPLATS else QUADS
    assert (display_mode(shown), cycles.transparent_max_bounces) == (best, 64)
    assert ("Bake for Linear Blending" in draw(extension, "show")) == compat.NATIVE_SPLATS
    with failure("displayed as trained"):
        ops.preview_images()
    set_input(shown, DISPLAY, AS_TRAINED)
    scene.camera = None
    ops.preview_images()
    assert display_mode(shown) == (NATIVE if compat.NATIVE_SPLATS else POINTS)
    tree = splat_modifier(shown).node_group
    menus = [node for node in tree.nodes if node.bl_idname == "GeometryNodeMenuSwitch"]
    items = [item for menu in menus for item in menu.enum_definition.enum_items]
    expected = LIMITS | LIGHTS if compat.NATIVE_SPLATS else LIMITS.keys() - {NATIVE}
    assert {item.name for item in items} == set(expected)
    assert all(item.description == (LIMITS | LIGHTS)[item.name] for item in items)
