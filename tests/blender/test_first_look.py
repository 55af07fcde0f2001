"""What an imported capture looks like: framed viewports, bones that are posed by one button."""

import numpy as np
import pytest
from PIL import Image

bpy = pytest.importorskip("bpy")

from capture.factory import write_flame_capture, write_mesh_capture  # noqa: E402
from mathutils import Vector  # noqa: E402

from stga_addon.development.demo.capture import unpack_capture  # noqa: E402
from stga_addon.export.ply import write_ply  # noqa: E402
from stga_addon.scene import tags  # noqa: E402
from stga_addon.scene.avatar_scene import frame_head  # noqa: E402
from stga_addon.scene.display.splat_nodes import (  # noqa: E402
    AS_TRAINED,
    DISPLAY,
    LIMITS,
    POINTS,
    QUADS,
)
from stga_addon.scene.display.splat_object import display_mode, set_input, splat_modifier  # noqa: E402
from stga_addon.scene.objects import layers_of  # noqa: E402

from .test_operators import write_ball_avatar  # noqa: E402


@pytest.fixture
def head(extension, tmp_path):
    folder, model = write_flame_capture(tmp_path / "capture")
    bpy.ops.stga.import_capture(directory=str(folder), flame=str(model))
    return bpy.context.scene.stga.head


def viewports() -> list:
    return [
        area.spaces.active
        for screen in bpy.data.screens
        for area in screen.areas
        if area.type == "VIEW_3D"
    ]  # fmt: skip


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
        np.testing.assert_allclose(np.array(region.view_rotation.to_matrix()), expected, atol=1e-5)


def test_a_world_is_hidden_until_it_is_wanted(extension, tmp_path):
    """Catches a wall that covers the scene or lies down, and a second one."""
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    avatar = write_ball_avatar(tmp_path / "avatar.npz")
    write_ply(tmp_path / "world.ply", avatar.splats)
    for _ in range(2):
        bpy.ops.stga.show_avatar(filepath=str(tmp_path / "avatar.npz"))
    (world,) = [thing for thing in bpy.data.objects if thing.get(tags.WORLD)]
    head = bpy.context.scene.stga.head
    bpy.context.view_layer.update()
    assert (world.hide_get(), world.hide_render, bpy.context.scene.stga.splats is not world) == (
        True,
        True,
        True,
    )
    np.testing.assert_allclose(np.array(world.matrix_world), np.array(head.matrix_world), atol=1e-6)
    assert len(world.data.vertices) == len(avatar.splats)


@pytest.mark.parametrize("moved", [False, True])
def test_the_start_up_cube_does_not_enclose_the_head(extension, tmp_path, moved):
    """Catches a first look from within the default cube, and an artist's cube removed."""
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    cube.location.x = float(moved)
    bpy.context.view_layer.update()
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    assert (cube.name, cube.hide_get(), cube.hide_render) == ("Cube", not moved, not moved)


def test_a_cube_that_the_artist_shows_again_stays(extension, tmp_path):
    """Catches a cube that every import hides, also where it is meant to be seen."""
    bpy.ops.mesh.primitive_cube_add()
    cube, folder = bpy.context.object, str(write_mesh_capture(tmp_path / "capture"))
    bpy.ops.stga.import_capture(directory=folder)
    assert cube.hide_get()
    cube.hide_set(False)
    cube.hide_render = False
    bpy.ops.stga.import_capture(directory=folder)
    assert not cube.hide_get()
    assert not cube.hide_render


def test_pose_the_jaw_and_back(head):
    """Catches bones that stay hidden, another bone that is selected, and no way back."""
    layer = bpy.context.view_layer
    (bones,) = layers_of(head.parent, tags.RIG, layer)
    assert bones.hide_viewport
    assert bpy.ops.stga.pose_head() == {"FINISHED"}
    rig = layer.objects.active
    assert (rig.get(tags.KIND), rig.mode, bones.hide_viewport) == (tags.RIG, "POSE", False)
    owners = rig.pose.bones if bpy.app.version >= (5, 0, 0) else rig.data.bones
    assert [bone.name for bone in owners if bone.select] == ["jaw"]
    assert rig.data.bones.active.name == "jaw"
    assert bpy.ops.stga.pose_head() == {"FINISHED"}
    assert (rig.mode, bones.hide_viewport) == ("OBJECT", True)


def test_pose_the_bundled_head(extension, tmp_path):
    """Catches a button that selects the jaw of a head whose jaw no bone moves."""
    unpack_capture(tmp_path)
    bpy.ops.stga.import_capture(directory=str(tmp_path))
    bpy.ops.stga.pose_head()
    assert bpy.context.view_layer.objects.active.data.bones.active.name == "neck"


def test_heads_without_bones_say_so(extension, tmp_path):
    """Catches a traceback, or a mode without bones, where a head has no rig."""
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    with pytest.raises(RuntimeError, match="poll"):
        bpy.ops.stga.pose_head()


def test_images_by_cycles_show_as_trained_by_quads(extension, tmp_path):
    """Catches images by Blender's engines where an avatar is missing, or points."""
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    write_ball_avatar(tmp_path / "avatar.npz")
    bpy.ops.stga.show_avatar(filepath=str(tmp_path / "avatar.npz"))
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.render.image_settings.file_format, scene.render.filepath = (
        "PNG",
        str(tmp_path / "image.png"),
    )
    images = {}
    for mode in (AS_TRAINED, QUADS, POINTS):
        set_input(scene.stga.splats, DISPLAY, mode)
        bpy.ops.render.render(write_still=True)
        images[mode] = np.asarray(Image.open(tmp_path / "image.png")).astype(int)
    assert images[QUADS][..., :3].max() > 50
    np.testing.assert_array_equal(images[AS_TRAINED], images[QUADS])
    assert np.abs(images[AS_TRAINED] - images[POINTS]).max() > 20


def test_cycles_sees_through_splats_that_are_shown(extension, tmp_path):
    """Catches F12 in Cycles with holes, and limits lowered or raised needlessly."""
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    write_ball_avatar(tmp_path / "avatar.npz")
    other, cycles = bpy.data.scenes.new("other").cycles, bpy.context.scene.cycles
    before = other.transparent_max_bounces, other.min_transparent_bounces
    bpy.ops.stga.show_avatar(filepath=str(tmp_path / "avatar.npz"))
    assert (cycles.transparent_max_bounces, cycles.min_transparent_bounces) == (64, 64)
    cycles.transparent_max_bounces, cycles.min_transparent_bounces = 200, 8
    bpy.ops.stga.show_avatar(filepath=str(tmp_path / "avatar.npz"))
    assert (cycles.transparent_max_bounces, cycles.min_transparent_bounces) == (200, 64)
    assert (other.transparent_max_bounces, other.min_transparent_bounces) == before


def test_preview_for_other_engines(extension, tmp_path):
    """Catches quads that face no camera, black holes, and displays without limits."""
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    write_ball_avatar(tmp_path / "avatar.npz")
    bpy.ops.stga.show_avatar(filepath=str(tmp_path / "avatar.npz"))
    scene = bpy.context.scene
    shown, scene.render.engine, scene.cycles.transparent_max_bounces = (
        scene.stga.splats,
        "CYCLES",
        8,
    )
    assert bpy.ops.stga.preview_images() == {"FINISHED"}
    assert (display_mode(shown), scene.cycles.transparent_max_bounces) == (QUADS, 64)
    with pytest.raises(RuntimeError, match="displayed as trained"):
        bpy.ops.stga.preview_images()
    set_input(shown, DISPLAY, AS_TRAINED)
    scene.camera = None
    assert bpy.ops.stga.preview_images() == {"FINISHED"}
    assert display_mode(shown) == POINTS
    tree = splat_modifier(shown).node_group
    menu = next(node for node in tree.nodes if node.bl_idname == "GeometryNodeMenuSwitch")
    described = {item.name: item.description for item in menu.enum_definition.enum_items}
    assert described == {name: LIMITS[name] for name in described}
