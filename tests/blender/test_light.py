"""Lights, worlds and objects as an avatar sees them, against Cycles; its colors."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from capture.factory import write_mesh_capture
from light.scenes import lit_avatar
from mathutils import Matrix, Vector
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.file import read_avatar, write_avatar
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light.lamps import LIFT_M, Lamps
from stga_addon.scene.arrays import read_values, triangle_mesh
from stga_addon.scene.compat import enable_nodes
from stga_addon.scene.display.splat_attributes import LINEAR_SH, read_attribute
from stga_addon.scene.display.splat_nodes import PERCENTAGE
from stga_addon.scene.display.splat_object import hide_object, set_input, show_avatar, stored_avatar
from stga_addon.scene.light import throw_shadow, throws_shadow
from stga_addon.scene.render.scene_splats import SplatCache

from .session import failure, ops, picture, placed, shown_layers
from .test_engine import add_sun
from .test_other_engines import EEVEE, EEVEE_MARKS
from .test_splat_object import active_camera

TURN = Matrix.Rotation(0.7, 3, Vector((1, 2, 0.5)).normalized())
PLACE = Matrix.LocRotScale(Vector((0.4, -0.2, 0.3)), TURN, (1.3,) * 3)
"""Of the head in the world."""
BALL = 642
"""Vertices of the ball; after them come those of the plate, at whose edges normals are not the
surface's."""


pytestmark = pytest.mark.usefixtures("lighting")


def shown_head():
    """An avatar with its light on a head at PLACE; returns splats and head."""
    avatar = lit_avatar()
    head = placed("head", triangle_mesh("head", avatar.neutral, avatar.faces))
    head.matrix_world = PLACE
    bpy.context.view_layer.update()
    shown = show_avatar(avatar, head)
    hide_object(head, bpy.context.scene)
    bpy.context.scene.stga_lighting.mode = "scene"
    bpy.context.scene.world = bpy.data.worlds.new("world")
    background(bpy.context.scene.world)["Strength"].default_value = 0.0
    return shown, head


def background(world):
    return enable_nodes(world).nodes["Background"].inputs


def lamp(kind, location, energy, **properties):
    """A light that shines at PLACE's head."""
    light = bpy.data.lights.new(kind, kind)
    light.energy = energy
    light.color = (1.0, 0.8, 0.5)
    for name, value in properties.items():
        setattr(light, name, value)
    made = placed(kind, light)
    made.location = location
    outward = Vector(location) - PLACE.translation
    made.rotation_euler = outward.to_track_quat("Z", "Y").to_euler()
    return made


def relit():
    bpy.context.view_layer.update()
    (layer,) = shown_layers()
    return layer.relit


def light_irradiance(found):
    """(BALL, 3) that arrives at the ball's vertices."""
    normals = vertex_normals(found.mesh, found.relighter.avatar.faces)
    lamps = Lamps(found.lighting, found.mesh, found.relighter.avatar.faces, found.casters)
    world = found.relighter.distant_in_head(found.mesh, found.lighting)[0][:, :3]
    arriving = np.maximum(found.relighter.light.transfer @ world, 0)
    return (lamps.irradiance(found.mesh + LIFT_M * normals, normals) + arriving)[:BALL]


def baked_irradiance(shown, head):
    """(BALL, 3) by Cycles: direct light on white, diffuse vertices."""
    shown.hide_render = True  # splats shine themselves
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 32
    scene.cycles.use_denoising = False
    head.hide_set(False)
    head.hide_viewport = False
    head.hide_render = False
    material = bpy.data.materials.new("white")
    nodes = enable_nodes(material).nodes
    nodes.clear()
    white = nodes.new("ShaderNodeBsdfDiffuse")
    out = nodes.new("ShaderNodeOutputMaterial")
    white.inputs[0].default_value = (1, 1, 1, 1)
    material.node_tree.links.new(white.outputs[0], out.inputs[0])
    head.data.materials.append(material)
    baked = head.data.color_attributes.new("baked", "FLOAT_COLOR", "POINT")
    head.data.attributes.active_color = baked
    for each in bpy.context.selected_objects:
        each.select_set(False)
    head.select_set(True)
    bpy.context.view_layer.objects.active = head
    bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT"}, target="VERTEX_COLORS")
    return read_values(head.data.color_attributes["baked"].data, "color", 4)[:BALL, :3] * np.pi


POINT = {"shadow_soft_size": 0.01}
WARM = {"normalize": False, "use_temperature": True, "temperature": 3e3}
LAMPS = {
    "sun": ("SUN", (1.0, -0.5, 2.0), 3.0, {"angle": 0.02}),
    "point": ("POINT", (0.9, -0.6, 0.9), 20.0, POINT),
    "spot": ("SPOT", (0.9, -0.6, 0.9), 80.0, POINT | {"spot_size": 0.4, "spot_blend": 0.6}),
    "area": ("AREA", (0.4, -1.0, 0.8), 10.0, {"shape": "RECTANGLE", "size": 0.3, "size_y": 0.1}),
    "disk": ("AREA", (1.2, 0.6, 0.8), 4.0, {"shape": "DISK", "size": 0.2, "exposure": 1.5}),
    "warm": ("AREA", (0.4, -1.0, 0.8), 90.0, {"size": 0.2} | WARM),
}


def check_irradiance(shown, head, limit):
    arriving = light_irradiance(relit())
    expected = baked_irradiance(shown, head)
    assert arriving.mean(0) == pytest.approx(expected.mean(0), rel=0.05)
    error = np.abs(arriving - expected).mean() / expected.mean()
    print(f"{arriving.mean() / expected.mean() - 1:.1%}, each vertex {error:.1%}")
    assert error < limit


@pytest.mark.slow
@pytest.mark.parametrize("name", LAMPS)
def test_irradiance_is_that_of_cycles(name):
    """Catches another place, unit, color, size or shadow than Blender's, beyond 5 % of the mean."""
    shown, head = shown_head()
    kind, location, energy, properties = LAMPS[name]
    lamp(kind, location, energy, **properties)
    if kind != "AREA":  # whose shadows are harder than they should be
        between = PLACE.translation.lerp(Vector(location), 0.4)
        bpy.ops.mesh.primitive_cube_add(size=0.05, location=between)
    check_irradiance(shown, head, 0.1)


def sky(size=(64, 32)):
    """A float image: blue above, and a warm glow to one side."""
    image = bpy.data.images.new("sky", *size, float_buffer=True)
    u, v = np.meshgrid(*((np.arange(pixels) + 0.5) / pixels for pixels in size))
    glow = np.exp(-4 * ((u - 0.3) ** 2 + (v - 0.6) ** 2))
    pixels = np.stack([glow, 0.5 * glow + 0.1 * v, 0.3 * v, np.ones_like(u)], -1).astype(np.float32)
    image.pixels.foreach_set(pixels.ravel())
    return image


def use_texture(world, image, kind):
    nodes = world.node_tree.nodes
    links = world.node_tree.links
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = image
    links.new(texture.outputs["Color"], nodes["Background"].inputs["Color"])
    if kind:
        turn = nodes.new("ShaderNodeMapping")
        source = nodes.new("ShaderNodeTexCoord")
        turn.vector_type = kind
        turn.inputs["Rotation"].default_value = (0.4, 0.3, 1.1)
        links.new(source.outputs["Generated"], turn.inputs["Vector"])
        links.new(turn.outputs["Vector"], texture.inputs["Vector"])


@pytest.mark.slow
@pytest.mark.parametrize("case", ["color", "texture", "turned point", "turned texture"])
def test_world_is_that_of_cycles(case):
    """Catches a turned environment, its strength, and occlusion, beyond 5 % of the mean."""
    shown, head = shown_head()
    world = bpy.context.scene.world
    background(world)["Strength"].default_value = 1.7
    background(world)["Color"].default_value = (0.2, 0.5, 0.7, 1)
    if case != "color":
        kind = {"turned point": "POINT", "turned texture": "TEXTURE"}.get(case)
        use_texture(world, sky(), kind)
    check_irradiance(shown, head, 0.05)


def test_lights_that_do_not_count():
    """Catches light linking, hidden lights, a collection or world switch ignored."""
    shown, _ = shown_head()
    lighting = bpy.context.scene.stga_lighting
    kinds = [lamp(kind, (1.0, -0.5, 2.0), 3.0) for kind in ("SUN", "POINT", "SPOT")]
    background(bpy.context.scene.world)["Strength"].default_value = 1.0

    def found():
        return [light.kind for light in relit().lighting.lights]

    assert found() == ["sun", "point", "spot"]
    kinds[0].hide_render = True
    assert found() == ["point", "spot"]
    cases = (
        (shown, "EXCLUDE", ["spot"]),
        (kinds[0], "INCLUDE", ["spot"]),
        (shown, "INCLUDE", ["point", "spot"]),
    )
    for receivers, state, expected in cases:
        collection = bpy.data.collections.new("receivers")
        collection.objects.link(receivers)
        collection.collection_objects[0].light_linking.link_state = state
        kinds[1].light_linking.receiver_collection = collection
        assert found() == expected
    chosen = bpy.data.collections.new("chosen")
    chosen.objects.link(kinds[2])
    lighting.lights = chosen
    assert found() == ["spot"]
    assert relit().lighting.world.any()
    lighting.world = False
    assert not relit().lighting.world.any()
    lighting.mode = "recorded"
    assert relit() is None


def test_nothing_is_made_anew_while_nothing_moves():
    """Catches a redraw that relights what it has, or keeps earlier light, pose or caster."""
    _, head = shown_head()
    light = lamp("POINT", (1.0, -0.5, 1.0), 30.0)
    bpy.ops.mesh.primitive_cube_add(size=0.1, location=(1, 1, 1))
    cube = bpy.context.object
    cache = SplatCache()

    def again():
        bpy.context.view_layer.update()
        (layer,) = shown_layers(cache)
        return layer.relit

    first = again()
    assert again() is first
    light.data.energy = 31
    brighter = again()
    assert brighter is not first
    assert brighter.lighting.lights[0].color[0] == pytest.approx(31 / 1.3**2)
    assert brighter.casters is first.casters
    cube.location.x += 1
    cache.light.forget_casters()
    assert np.abs(again().casters[0].vertices - first.casters[0].vertices).max() > 0.5
    head.data.vertices[0].co.x += 0.01
    head.data.update()
    assert again().mesh is not brighter.mesh


@pytest.mark.parametrize(
    "engine", ["CYCLES", pytest.param(EEVEE, marks=(*EEVEE_MARKS, pytest.mark.nightly))]
)
def test_shadow_onto_the_scene(engine, tmp_path):
    """Catches a head seen where it should only throw its shadow, and no shadow."""
    shown, head = shown_head()
    lamp("SUN", (0.4, -0.2, 2.0), 3.0)
    bpy.ops.mesh.primitive_plane_add(size=2, location=(0.4, -0.2, 0.0))
    scene = bpy.context.scene
    active_camera((0.4, -0.2, 3.0))
    scene.eevee.shadow_pool_size = "16"
    scene.eevee.shadow_resolution_scale = 0.1
    scene.view_settings.view_transform = "Raw"
    set_input(shown, PERCENTAGE, 0.0)

    def middle():
        image = picture(tmp_path / "image.png", engine, 32, 4 if engine == "CYCLES" else 1)
        return image[15:17, 15:17, :3].mean()

    open_ground = middle()
    throw_shadow(shown, True)
    assert throws_shadow(shown)
    assert middle() < 0.2 * open_ground
    throw_shadow(shown, False)
    assert middle() == pytest.approx(open_ground, rel=0.05)
    assert head.hide_render


@pytest.mark.slow
def test_estimate_light(extension, tmp_path):
    """Catches a light other than training's, that does not reach the splats, or reaches others."""
    run = tmp_path / "run"
    scene = bpy.context.scene
    ops.import_capture(directory=write_mesh_capture(tmp_path / "capture"))
    ops.train(directory=run, iterations=6, device="cpu")
    trained = read_avatar(run / "avatar.npz")
    write_avatar(run / "avatar.npz", replace(trained, light=None))
    ops.show_avatar(filepath=run / "avatar.npz")
    shown = scene.stga.splats
    scene.stga.run_folder = str(run)
    assert stored_avatar(shown).light is None
    add_sun()
    scene.stga_lighting.mode = "scene"

    ops.estimate_light()
    found = stored_avatar(shown).light
    for name in vars(found).keys() - {"source"}:
        assert_allclose(getattr(found, name), getattr(trained.light, name), atol=1e-6, err_msg=name)
    assert found.source == "estimated"
    assert read_avatar(run / "avatar.npz").light.source == "estimated"

    ops.make_exact()
    fitted = read_avatar(run / "avatar.npz")
    assert fitted.light is not None
    assert_array_equal(fitted.splats.sh, trained.splats.sh)
    kept = read_attribute(shown.data, LINEAR_SH)
    assert_array_equal(kept, fitted.linear_base[:, :3])
    assert np.abs(kept - trained.splats.sh[:, 0]).max() > 0.01
    assert [light.kind for light in relit().lighting.lights] == ["sun"]

    write_avatar(tmp_path / "other.npz", replace(trained, splats=trained.splats.rows(np.arange(9))))
    ops.show_avatar(filepath=tmp_path / "other.npz")
    scene.stga.run_folder = str(run)
    assert LINEAR_SH not in scene.stga.splats.data.attributes
    for add in (ops.estimate_light, ops.make_exact):
        with failure("is not the one that the scene shows"):
            add()
