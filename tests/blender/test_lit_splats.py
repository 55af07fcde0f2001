"""Native splats in the scene's light: what they and their shadows are made of, and images."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from light.scenes import RADIUS, lit_avatar
from mathutils import Vector
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light.relight import Relighter
from stga_addon.light.values import SKIN_ROUGHNESS
from stga_addon.scene import compat
from stga_addon.scene.arrays import mesh_vertices
from stga_addon.scene.display import splat_attributes as stored
from stga_addon.scene.display.lit_nodes import (
    ALBEDO,
    NORMAL,
    RECORDED,
    SCENE_LIGHT,
    SHRINKAGE_M,
)
from stga_addon.scene.display.splat_nodes import DISPLAY, NATIVE, NATIVE_LIGHT, POINTS
from stga_addon.scene.display.splat_object import set_input, store_light
from stga_addon.scene.light import throw_shadow
from stga_addon.scene.render.scene_splats import light_hint

from .session import picture
from .test_light import BALL, background, lamp, shown_head
from .test_other_engines import EEVEE, EEVEE_MARKS
from .test_panel import draw
from .test_splat_object import active_camera

pytestmark = [
    pytest.mark.usefixtures("lighting"),
    pytest.mark.skipif(not compat.NATIVE_SPLATS, reason="Blender before 5.3 has no native splats"),
]


def native_head():
    shown, head = shown_head()
    set_input(shown, DISPLAY, NATIVE)
    return shown, head


def parts_of(shown):
    """Kind of data -> attributes of what a splat object is evaluated to, and its materials."""
    bpy.context.view_layer.update()
    found = {}
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        owner = instance.parent if instance.is_instance else instance.object
        if owner.original == shown:
            data = instance.object.data
            known = [each for each in data.attributes if each.data_type in stored._FIELDS]
            values = {each.name: stored.read_attribute(data, each.name) for each in known}
            if not len(values["position"]):
                continue
            values["material"] = [each.name for each in data.materials if each is not None]
            found[instance.object.type] = values
    return found


def test_lit_splats_have_albedo_and_normals_and_a_mesh_throws_shadows():
    """Catches recorded colors that are lit again, roughness of none, normals that do not follow
    the head or are those of other triangles where it is subdivided, a mesh in whose shadow its own
    splats lie, and light that is estimated later."""
    shown, head = native_head()
    avatar = lit_avatar()
    plate = mesh_vertices(head.data)
    plate[BALL:] -= (0, 0.04, 0)  # to 2 cm above the ball
    head.data.vertices.foreach_set("co", plate.ravel())
    head.data.update()
    set_input(shown, NATIVE_LIGHT, SCENE_LIGHT)
    parts = parts_of(shown)
    cloud = parts["POINTCLOUD"]
    assert_allclose(cloud[ALBEDO][:, :3], Relighter(avatar).albedo, atol=1e-5)
    assert_allclose(cloud[ALBEDO][:, 3], SKIN_ROUGHNESS)
    normals = vertex_normals(plate.astype(np.float64), avatar.faces)[avatar.faces].mean(1)
    on_ball = avatar.faces.max(1) < BALL  # elsewhere the weights of faces at a corner matter
    assert_allclose(cloud[NORMAL][on_ball], normals[on_ball], atol=6e-3)
    divided = head.modifiers.new("subdivision", "SUBSURF")
    divided.subdivision_type = "SIMPLE"
    on_divided = parts_of(shown)["POINTCLOUD"]
    head.modifiers.remove(divided)
    for name in ("position", NORMAL):
        assert_allclose(on_divided[name], cloud[name], atol=1e-5)
    assert not [name for name in cloud if name.startswith("stga")]
    assert cloud["material"] == ["STGA Lit Splats"]
    caster = parts["MESH"]["position"]
    radius = norm(caster, axis=1)
    on_ball = caster[radius < RADIUS]
    assert_allclose(norm(on_ball, axis=1), RADIUS - SHRINKAGE_M, atol=2e-4)
    down = on_ball / norm(on_ball, axis=1, keepdims=True)
    below = plate[BALL:].mean(0) / norm(plate[BALL:].mean(0))
    assert (down @ below).max() < 0.99  # near skin throws none onto other
    assert (down @ below).min() < -0.99
    brighter = replace(avatar.light, irradiance=2 * avatar.light.irradiance)
    assert store_light(shown, replace(avatar, light=brighter))
    expected = Relighter(replace(avatar, light=brighter)).albedo
    found = parts_of(shown)["POINTCLOUD"][ALBEDO][:, :3]
    assert_allclose(found, expected, atol=1e-5)


def test_nothing_is_left_of_the_scenes_light(tmp_path):
    """Catches attributes, materials, objects or settings that stay when colors are recorded again
    or the avatar is removed, and duplicates or appended avatars that are lit in another way."""
    shown, _ = native_head()
    objects = set(bpy.data.objects)
    before = parts_of(shown)
    assert before.keys() == {"POINTCLOUD"}
    assert before["POINTCLOUD"]["material"] == []
    set_input(shown, NATIVE_LIGHT, SCENE_LIGHT)
    lit = parts_of(shown)
    assert set(bpy.data.objects) == objects
    copy = shown.copy()
    bpy.context.scene.collection.objects.link(copy)
    file = tmp_path / "a.blend"
    bpy.data.libraries.write(str(file), {copy}, fake_user=True)
    with bpy.data.libraries.load(str(file)) as (_, target):
        target.objects = [copy.name]
    appended = target.objects[0]
    bpy.context.scene.collection.objects.link(appended)
    bpy.data.objects.remove(shown)
    assert len(bpy.data.objects) == len(objects) + 3  # with head and neutral mesh of the appended
    for each in (copy, appended):
        found = parts_of(each)
        assert found.keys() == lit.keys() == {"POINTCLOUD", "MESH"}
        for kind, values in found.items():
            assert values.keys() == lit[kind].keys()
            assert values["material"][0].startswith(lit[kind]["material"][0])
        set_input(each, NATIVE_LIGHT, RECORDED)
        again = parts_of(each)
        assert again.keys() == before.keys()
        for name, values in before["POINTCLOUD"].items():
            assert_array_equal(again["POINTCLOUD"][name], values)


def test_the_panel_offers_the_light_of_native_splats(extension):
    """Catches a choice that is not offered, or offered for other displays, a hint that images do
    not show the scene's light where they do, and none where the head's mesh shadows its splats."""
    shown, _ = native_head()
    scene = bpy.context.scene
    scene.stga.splats = shown
    assert NATIVE_LIGHT in draw(extension, "show")
    assert "render colors as recorded" in light_hint(scene)
    set_input(shown, NATIVE_LIGHT, SCENE_LIGHT)
    assert light_hint(scene) is None
    throw_shadow(shown, True)
    assert "turn Head Shadow off" in light_hint(scene)
    throw_shadow(shown, False)
    assert light_hint(scene) is None
    set_input(shown, DISPLAY, POINTS)
    assert NATIVE_LIGHT not in draw(extension, "show")
    assert light_hint(scene) is not None


@pytest.mark.parametrize("engine", [pytest.param(EEVEE, marks=EEVEE_MARKS), "CYCLES"])
def test_lamps_shine_on_native_splats(engine, tmp_path):
    """Catches splats that shine themselves, darken themselves, throw no shadow onto meshes, or get
    none from them, and recorded ones that a lamp changes."""
    shown, head = native_head()
    shown.data.attributes[stored.SCALE].data.foreach_set(
        "vector", np.full(3 * len(shown.data.vertices), 0.004, np.float32)
    )
    scene = bpy.context.scene
    center = head.matrix_world.translation
    camera = active_camera(center + Vector((0, -1.2, 0)))
    camera.rotation_euler = (np.pi / 2, 0, 0)
    background(scene.world)["Strength"].default_value = 0.0
    bpy.ops.mesh.primitive_plane_add(
        size=3, location=center + Vector((0, 0.4, 0)), rotation=(np.pi / 2, 0, 0)
    )
    scene.view_settings.view_transform = "Standard"

    def image():
        whole = picture(tmp_path / "image.png", engine, 40, 16 if engine == "CYCLES" else 8)
        return whole[..., :3].mean(-1) / 255

    ball = (slice(16, 24), slice(15, 25))
    right = (slice(16, 24), slice(22, 25))
    left = (slice(16, 24), slice(15, 18))
    recorded = image()
    set_input(shown, NATIVE_LIGHT, SCENE_LIGHT)
    assert image()[ball].max() < 0.02  # no light
    sun = lamp("SUN", tuple(center + Vector((-1.0, -1.0, 0.0))), 3.0, angle=0.0)
    lit = image()
    assert lit[left].mean() > 1.5 * lit[right].mean() > 0
    assert lit[left].mean() > 0.2
    wall = lit[18:22, 28:]
    assert wall.min() < 0.3 * wall.max()  # the ball's shadow
    bpy.ops.mesh.primitive_plane_add(size=0.5, location=center + Vector((-0.4, -0.4, 0)))
    bpy.context.object.rotation_euler = sun.rotation_euler
    assert image()[left].mean() < 0.5 * lit[left].mean()
    bpy.data.objects.remove(bpy.context.object)
    bpy.data.objects.remove(sun)
    set_input(shown, NATIVE_LIGHT, RECORDED)
    assert_allclose(image(), recorded, atol=0.01)
