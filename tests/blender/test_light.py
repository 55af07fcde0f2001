"""Lights, worlds and objects as an avatar sees them, against Cycles; its colors."""

import sys
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
pytest.importorskip("numba")
pytest.importorskip("trimesh")

from mathutils import Matrix, Vector  # noqa: E402
from mathutils.bvhtree import BVHTree  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from light.scenes import lit_avatar  # noqa: E402

from stga_addon.capture.mesh_geometry import vertex_normals  # noqa: E402
from stga_addon.light.lamps import LIFT_M, Lamps, ShadowMap  # noqa: E402
from stga_addon.scene import light as settings  # noqa: E402
from stga_addon.scene.arrays import read_values, triangle_mesh  # noqa: E402
from stga_addon.scene.compat import enable_nodes  # noqa: E402
from stga_addon.scene.display.splat_nodes import PERCENTAGE  # noqa: E402
from stga_addon.scene.display.splat_object import hide_object, set_input, show_avatar, stored_avatar  # noqa: E402
from stga_addon.scene.layers import Relit  # noqa: E402
from stga_addon.scene.light import throw_shadow, throws_shadow  # noqa: E402
from stga_addon.scene.render.scene_splats import SplatCache, visible_layers  # noqa: E402

from .exr import read_exr  # noqa: E402
from .test_other_engines import EEVEE, EEVEE_MARKS  # noqa: E402

TURN = Matrix.Rotation(0.7, 3, Vector((1, 2, 0.5)).normalized())
PLACE = Matrix.LocRotScale(Vector((0.4, -0.2, 0.3)), TURN, (1.3,) * 3)
"""Of the head in the world."""
BALL = 642
"""Vertices of the ball; after them come those of the plate, at whose edges normals are not the
surface's."""


@pytest.fixture(autouse=True)
def _settings(empty_scene):
    # by the extension, in other tests
    registered = settings.lighting_settings(bpy.context.scene) is not None
    if not registered:
        settings.register()
    yield
    if not registered:
        settings.unregister()


def shown_head():
    """An avatar with its light on a head at PLACE; returns splats and head."""
    avatar = lit_avatar()
    head = bpy.data.objects.new("head", triangle_mesh("head", avatar.neutral, avatar.faces))
    bpy.context.scene.collection.objects.link(head)
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


def lamp(kind: str, location: tuple[float, ...], energy: float, **properties: object):
    """A light that shines at PLACE's head."""
    light = bpy.data.lights.new(kind, kind)
    light.energy, light.color = energy, (1.0, 0.8, 0.5)
    for name, value in properties.items():
        setattr(light, name, value)
    placed = bpy.data.objects.new(kind, light)
    placed.location = location
    placed.rotation_euler = (
        (Vector(location) - PLACE.translation).to_track_quat("Z", "Y").to_euler()
    )
    bpy.context.scene.collection.objects.link(placed)
    return placed


def relit() -> Relit | None:
    bpy.context.view_layer.update()
    (layer,) = visible_layers(bpy.context.evaluated_depsgraph_get(), SplatCache())
    return layer.relit


def light_irradiance(found: Relit) -> np.ndarray:
    """(BALL, 3) that arrives at the ball's vertices."""
    normals = vertex_normals(found.mesh, found.relighter.avatar.faces)
    lamps = Lamps(found.lighting, found.mesh, found.relighter.avatar.faces, found.casters)
    world = np.maximum(
        found.relighter.light.transfer
        @ found.relighter.world_in_head(found.mesh, found.lighting.world),
        0,
    )
    return (lamps.irradiance(found.mesh + LIFT_M * normals, normals) + world)[:BALL]


def whiten(head) -> None:
    """Let the head's mesh be seen in images, white and diffuse."""
    head.hide_set(False)
    head.hide_render = False
    material = bpy.data.materials.new("white")
    nodes = enable_nodes(material).nodes
    nodes.clear()
    white, out = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    white.inputs[0].default_value = (1, 1, 1, 1)
    material.node_tree.links.new(white.outputs[0], out.inputs[0])
    head.data.materials.append(material)


def baked_irradiance(shown, head) -> np.ndarray:
    """(BALL, 3) by Cycles: direct light on white, diffuse vertices."""
    shown.hide_render = True  # splats shine themselves
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 32, False
    whiten(head)
    head.data.attributes.active_color = head.data.color_attributes.new(
        "baked", "FLOAT_COLOR", "POINT"
    )
    for each in bpy.context.selected_objects:
        each.select_set(False)
    head.select_set(True)
    bpy.context.view_layer.objects.active = head
    bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT"}, target="VERTEX_COLORS")
    return read_values(head.data.color_attributes["baked"].data, "color", 4)[:BALL, :3] * np.pi


LAMPS = {
    "sun": ("SUN", (1.0, -0.5, 2.0), 3.0, {"angle": 0.02}),
    "point": ("POINT", (0.9, -0.6, 0.9), 20.0, {"shadow_soft_size": 0.01}),
    "spot": (
        "SPOT", (0.9, -0.6, 0.9), 80.0,
        {"spot_size": 0.4, "spot_blend": 0.6, "shadow_soft_size": 0.01},
    ),
    "area": ("AREA", (0.4, -1.0, 0.8), 10.0, {"shape": "RECTANGLE", "size": 0.3, "size_y": 0.1}),
    "disk, exposed": (
        "AREA", (1.2, 0.6, 0.8), 4.0, {"shape": "DISK", "size": 0.2, "exposure": 1.5},
    ),
    "per area, warm": (
        "AREA", (0.4, -1.0, 0.8), 90.0,
        {"size": 0.2, "normalize": False, "use_temperature": True, "temperature": 3e3},
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", LAMPS)
def test_irradiance_is_that_of_cycles(name):
    """Catches a light in another place, unit, color or size than Blender's, and shadows of head or
    objects that are missing, beyond 5 % of the mean."""
    shown, head = shown_head()
    kind, location, energy, properties = LAMPS[name]
    lamp(kind, location, energy, **properties)
    if kind != "AREA":  # whose shadows are harder than they should be
        bpy.ops.mesh.primitive_cube_add(
            size=0.05, location=PLACE.translation.lerp(Vector(location), 0.4)
        )
    found = relit()
    expected = baked_irradiance(shown, head)
    arriving = light_irradiance(found)
    assert arriving.mean(0) == pytest.approx(expected.mean(0), rel=0.05)
    error = np.abs(arriving - expected).mean() / expected.mean()
    print(f"{name}: {arriving.mean() / expected.mean() - 1:.1%}, each vertex {error:.1%}")
    assert error < 0.1


SIDE_PX, WIDTH_M = 512, 0.34
MIN_FACING = 0.5
"""Cosine towards the light of surface whose shadows count: where it is less, lifted points see past
what blocks."""


def seen_points(head) -> tuple[np.ndarray, np.ndarray]:
    """What the scene's orthographic camera sees of the head in each pixel: points (H, W, 3) and
    normals in the world; NaN where there is none."""
    mesh = head.data
    corners = [PLACE @ vertex.co for vertex in mesh.vertices]
    tree = BVHTree.FromPolygons(corners, [tuple(polygon.vertices) for polygon in mesh.polygons])
    view = bpy.context.scene.camera.matrix_world
    across, up, back = (view.to_3x3() @ Vector(axis) for axis in np.eye(3))
    points, normals = np.full((2, SIDE_PX, SIDE_PX, 3), np.nan)
    offsets = (((np.arange(SIDE_PX) + 0.5) / SIDE_PX - 0.5) * WIDTH_M).tolist()
    for row, y in enumerate(offsets):
        for column, x in enumerate(offsets):
            place, normal, _, _ = tree.ray_cast(view.translation + x * across - y * up, -back)
            if place is not None:
                points[row, column], normals[row, column] = place, normal
    return points, normals


def edges(shadow: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(N, 2) pixels beside which lies one that is shadowed otherwise, where both count."""
    across = (shadow[:, 1:] != shadow[:, :-1]) & counts[:, 1:] & counts[:, :-1]
    down = (shadow[1:] != shadow[:-1]) & counts[1:] & counts[:-1]
    return np.concatenate(
        [np.argwhere(across) + np.array([0, 0.5]), np.argwhere(down) + np.array([0.5, 0])]
    )


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "energy"), [("SUN", 3.0), ("POINT", 30.0)])
def test_edges_of_shadows_are_those_of_cycles(kind, energy, tmp_path):
    """Catches shadows that are shifted or torn off by lift and bias: edges beyond 2 pixels of 512
    from the path tracer's."""
    shown, head = shown_head()
    head.data.shade_flat()
    location = tuple(PLACE @ Vector((0.6, 1.0, 0.2)))  # the plate throws its shadow onto the ball
    lamp(kind, location, energy, **({"angle": 0.0} if kind == "SUN" else {"shadow_soft_size": 0.0}))
    scene = bpy.context.scene
    camera = bpy.data.cameras.new("camera")
    camera.type, camera.ortho_scale = "ORTHO", WIDTH_M
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.collection.objects.link(scene.camera)
    scene.camera.location = PLACE @ Vector((-0.6, 0.9, 0.9))
    scene.camera.rotation_euler = (
        (scene.camera.location - PLACE.translation).to_track_quat("Z", "Y").to_euler()
    )
    found = relit()
    points, normals = seen_points(head)
    toward = np.array(location) - (points if kind == "POINT" else np.array(PLACE.translation))
    facing = (normals * toward).sum(2) / np.linalg.norm(toward, axis=-1)
    counts = facing > MIN_FACING

    into = np.linalg.inv(np.array(PLACE))
    inside = points[counts] @ into[:3, :3].T + into[:3, 3]
    turned = normals[counts] @ np.array(TURN)
    lit = np.zeros(counts.shape)
    depths = ShadowMap(found.mesh, found.relighter.avatar.faces, found.lighting.lights[0])
    lit[counts] = depths.lit(inside + LIFT_M * turned, normals=turned)
    expected = path_traced(shown, head, tmp_path / "image.exr") / np.maximum(facing, MIN_FACING)
    ours, theirs = (
        edges(lit < 0.5, counts),
        edges(expected < np.nanmax(expected[counts]) / 4, counts),
    )
    assert len(theirs) > 100
    apart = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    one, other = apart.min(0), apart.min(1)
    most = [float(np.quantile(distance, 0.95)) for distance in (one, other)]
    print(
        f"{kind}: {len(theirs)} pixels of edges; "
        f"mean {one.mean():.2f}, {other.mean():.2f}, 95 % {most} px"
    )
    assert max(most) < 2


def path_traced(shown, head, path: Path) -> np.ndarray:
    """(H, W) green radiance of the head in white by Cycles, direct light without noise."""
    shown.hide_render = True
    whiten(head)
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.cycles.max_bounces, scene.cycles.pixel_filter_type = 0, "BOX"
    scene.cycles.filter_width = 0.01
    scene.render.resolution_x = scene.render.resolution_y = SIDE_PX
    scene.render.image_settings.file_format, scene.render.image_settings.exr_codec = (
        "OPEN_EXR",
        "NONE",
    )
    scene.render.image_settings.color_depth, scene.view_settings.view_transform = "32", "Raw"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    channels = read_exr(path)
    return next(values for name, values in channels.items() if name.split(".")[-1] == "G")


def sky(size: tuple[int, int] = (64, 32)):
    """A float image: blue above, and a warm glow to one side."""
    image = bpy.data.images.new("sky", *size, float_buffer=True)
    v, u = np.meshgrid(
        (np.arange(size[1]) + 0.5) / size[1], (np.arange(size[0]) + 0.5) / size[0], indexing="ij"
    )
    glow = np.exp(-4 * ((u - 0.3) ** 2 + (v - 0.6) ** 2))
    pixels = np.stack([glow, 0.5 * glow + 0.1 * v, 0.3 * v, np.ones_like(u)], -1).astype(np.float32)
    image.pixels.foreach_set(pixels.ravel())
    return image


def use_texture(world, image, **mapping: object) -> None:
    nodes, links = world.node_tree.nodes, world.node_tree.links
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = image
    links.new(texture.outputs["Color"], nodes["Background"].inputs["Color"])
    if mapping:
        turn, source = nodes.new("ShaderNodeMapping"), nodes.new("ShaderNodeTexCoord")
        turn.vector_type, turn.inputs["Rotation"].default_value = (
            mapping["kind"],
            mapping["rotation"],
        )
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
        mapping = {"kind": kind, "rotation": (0.4, 0.3, 1.1)} if kind else {}
        use_texture(world, sky(), **mapping)
    found = relit()
    expected, arriving = baked_irradiance(shown, head), light_irradiance(found)
    error = np.abs(arriving - expected).mean() / expected.mean()
    print(f"{case}: {arriving.mean() / expected.mean() - 1:.1%}, each vertex {error:.1%}")
    assert arriving.mean(0) == pytest.approx(expected.mean(0), rel=0.05)
    assert error < 0.05


def test_lights_that_do_not_count():
    """Catches light linking, hidden lights, a collection or world switch ignored."""
    shown, _ = shown_head()
    lighting = bpy.context.scene.stga_lighting
    kinds = [lamp(kind, (1.0, -0.5, 2.0), 3.0) for kind in ("SUN", "POINT", "SPOT")]
    background(bpy.context.scene.world)["Strength"].default_value = 1.0

    def found() -> list[str]:
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
    cube, cache = bpy.context.object, SplatCache()

    def again() -> Relit:
        bpy.context.view_layer.update()
        (layer,) = visible_layers(bpy.context.evaluated_depsgraph_get(), cache)
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


def test_light_is_kept_in_the_file():
    """Catches an avatar's light that Blender's meshes hold otherwise than the avatar file."""
    shown, _ = shown_head()
    expected, found = lit_avatar().light, stored_avatar(shown).light
    for name in ("radiance", "transfer", "occlusion", "irradiance", "roughness"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-6)
    assert (found.residual, found.damping, found.source) == (
        expected.residual,
        expected.damping,
        expected.source,
    )


@pytest.mark.parametrize("engine", ["CYCLES", pytest.param(EEVEE, marks=EEVEE_MARKS)])
def test_shadow_onto_the_scene(engine, tmp_path):
    """Catches a head seen where it should only throw its shadow, and no shadow."""
    shown, head = shown_head()
    lamp("SUN", (0.4, -0.2, 2.0), 3.0)
    bpy.ops.mesh.primitive_plane_add(size=2, location=(0.4, -0.2, 0.0))
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.camera.location = (0.4, -0.2, 3.0)
    scene.collection.objects.link(scene.camera)
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = engine, 4, False
    scene.eevee.taa_render_samples, scene.eevee.shadow_pool_size = 1, "16"
    scene.eevee.shadow_resolution_scale = 0.1
    scene.render.resolution_x = scene.render.resolution_y = 32
    scene.view_settings.view_transform = "Raw"
    set_input(shown, PERCENTAGE, 0.0)

    def middle() -> float:
        scene.render.filepath = str(tmp_path / "image.png")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(str(tmp_path / "image.png"))
        value = np.array(image.pixels[:]).reshape(32, 32, 4)[15:17, 15:17, :3].mean()
        bpy.data.images.remove(image)
        return float(value)

    open_ground = middle()
    throw_shadow(shown, True)
    assert throws_shadow(shown)
    assert middle() < 0.2 * open_ground
    throw_shadow(shown, False)
    assert middle() == pytest.approx(open_ground, rel=0.05)
    assert head.hide_render
