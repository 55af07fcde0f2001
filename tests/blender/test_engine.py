"""The render engine against `render_avatar`, through files that Blender writes, and its errors."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from avatar.conftest import splats_of
from mathutils import Matrix, Vector
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.avatar.file import AvatarLight
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.camera import Camera
from stga_addon.capture.color import linear_to_srgb
from stga_addon.errors import DeviceError, StgaError
from stga_addon.export.ply import write_ply
from stga_addon.light.harmonics import uniform
from stga_addon.light.relight import Relighter
from stga_addon.light.surface import transfer_of
from stga_addon.light.values import HAIR_ROUGHNESS, Light, Lighting
from stga_addon.render.render import render_avatar
from stga_addon.scene import compat
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.compat import enable_nodes
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import set_input, show_world_splats
from stga_addon.scene.render import engine
from stga_addon.scene.render.scene_splats import SplatCache, native_layers

from .exr import read_exr
from .session import failure, placed, shown_layers
from .test_splat_object import (
    active_camera,
    avatar_of,
    driven_avatar,
    random_splats,
    show_on_head,
)

WIDTH = 96
HEIGHT = 64
TOLERANCE = 1 / 255


@pytest.fixture(autouse=True)
def _engine(empty_scene, monkeypatch):
    # Software graphics draw here, though the rasterizer would be faster.
    monkeypatch.setattr(engine, "is_rasterizer_faster", lambda: False)
    # The extension that other tests enable has an engine of this name, too: only one can be
    # registered.
    other = bpy.types.RenderEngine.bl_rna_get_subclass_py(engine.ENGINE, None)
    if other is not None:
        bpy.utils.unregister_class(other)
    engine.register(no_python)
    scene = bpy.context.scene
    scene.render.engine = engine.ENGINE
    scene.render.resolution_x = WIDTH
    scene.render.resolution_y = HEIGHT
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"
    scene.view_layers[0].use_pass_z = True
    yield
    engine.unregister()
    if other is not None:
        bpy.utils.register_class(other)


def no_python():
    raise StgaError("no training Python")


def camera_at(lens=60.0, **data):
    """A camera in front of `sphere`'s head, which stands turned around in the world."""
    camera = active_camera((0.45, -0.85, 1.05))
    camera.rotation_euler = (1.5, 0.1, 0.15)
    camera.data.lens = lens
    camera.data.clip_start = 0.01
    for name, value in data.items():
        setattr(camera.data, name, value)
    return camera


def add_sun(energy=1.0):
    sun = placed("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = energy
    sun.rotation_euler = (1.2, 0.0, 0.4)
    return sun


def textured(avatar, scale=-6.0):
    """Visible splats in muted colors."""
    rng = np.random.default_rng(5)
    count = len(avatar.splats)
    sh = rng.normal(0, 0.12, (count, 4, 3)).astype(np.float32)
    log_scale = rng.normal(scale, 0.3, (count, 3)).astype(np.float32)
    return replace(avatar, splats=replace(avatar.splats, sh=sh, log_scale=log_scale))


def show(avatar):
    shown, head = show_on_head(avatar)
    head.hide_render = True
    bpy.context.scene.frame_set(5)
    return shown, head


def multilayer(settings):
    """Choose files that hold all passes in float."""
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.exr_codec = "NONE"
    settings.color_depth = "32"


def render(folder):
    """Passes of one image in float: R, G, B, A and Depth, top row first."""
    multilayer(bpy.context.scene.render.image_settings)
    bpy.context.scene.render.filepath = str(folder / "image.exr")
    bpy.ops.render.render(write_still=True)
    return read_passes(folder / "image.exr")


def read_passes(path):
    ends = {c: f"Combined.{c}" for c in "RGBA"} | {"Depth": "Depth.Z"}
    found = read_exr(path).items()
    return {short: next(v for k, v in found if k.endswith(end)) for short, end in ends.items()}


def displayed(passes, background):
    """(3, H, W) sRGB values of an image with alpha over a gray sRGB background."""
    alpha = passes["A"]
    straight = np.stack([passes[c] for c in "RGB"]) / np.maximum(alpha, 1e-12)
    srgb = linear_to_srgb(np.maximum(straight, 0))
    return np.clip(srgb * alpha + (1 - alpha) * background, 0, 1)


def expected_camera(camera, shown, width=WIDTH, height=HEIGHT):
    """The expected camera in the splats' space: focal length in pixels, shift in widths."""
    bpy.context.view_layer.update()
    data = camera.data
    fit = "HORIZONTAL" if data.sensor_fit == "AUTO" and width >= height else data.sensor_fit
    across = width if fit == "HORIZONTAL" else height
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    focal = data.lens / sensor * across
    world_to_eye = np.linalg.inv(np.array(camera.matrix_world, np.float64))
    view = np.diag([1.0, -1.0, -1.0, 1.0]) @ world_to_eye @ np.array(shown.matrix_world)
    cx = width / 2 - data.shift_x * across
    cy = height / 2 + data.shift_y * across
    return Camera(width, height, focal, focal, cx, cy, view)


def driven():
    """An avatar with every part that the deformation moves or colors."""
    return replace(textured(driven_avatar("stga", count=3000), -6.5), antialiased=True)


@pytest.mark.parametrize(
    ("make", "background"),
    [(driven, 1.0), (lambda: textured(avatar_of("gaussian_avatars"), -1), 0.0)],
)
def test_image_equals_render_avatar(make, background, tmp_path):
    """Catches another camera, color, order or pose than `stga render`'s, and parts left out."""
    avatar = make()
    shown, head = show(avatar)
    camera = expected_camera(camera_at(), shown)
    expected = assert_renders(tmp_path, avatar, head, camera, background)
    assert np.abs(expected - background).max(0).mean() > 0.02, "nothing to compare"


def assert_renders(folder, avatar, head, camera, background=0.0, what=""):
    """Whether the image is that of `render_avatar`, which is returned."""
    expected = render_avatar(avatar, evaluated_vertices(head), camera, (background,) * 3)
    assert np.abs(displayed(render(folder), background) - expected).max() < TOLERANCE, what
    return expected


def vectors(folder):
    """(H, W, 4) of the pass Vector of one image."""
    render(folder)
    found = read_exr(folder / "image.exr").items()
    return np.stack(
        [next(v for k, v in found if k.endswith(f"Vector.{c}")) for c in "XYZW"], axis=-1
    )


@pytest.mark.parametrize("device", ["GPU", "CPU"])
def test_vectors_are_those_of_cycles(device, monkeypatch, tmp_path):
    """Catches motion of another sign, order, unit or frame than Cycles' of the mesh below the
    splats, without what the camera or the head's shape does, and a pass that nobody asked for."""
    if device == "CPU":
        monkeypatch.setattr(engine, "SplatRenderer", no_context)
    avatar = textured(avatar_of("stga"), -4.5)
    avatar.splats.opacity[:] = 8.0
    shown, head = show(avatar)
    camera = camera_at()
    scene = bpy.context.scene
    for frame, place in {4: (0.0, 0.02, 0.0), 5: (0.0, 0.0, 0.0), 6: (0.03, 0.01, 0.04)}.items():
        head.delta_location = place
        head.keyframe_insert("delta_location", frame=frame)
    for frame, x in {3: 0.0, 7: 0.05}.items():
        camera.delta_location.x = x
        camera.keyframe_insert("delta_location", index=0, frame=frame)
    for curve in [*compat.action_curves(head), *compat.action_curves(camera)]:
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
    scene.frame_set(5)
    alpha = render(tmp_path)["A"]
    assert not any("Vector" in name for name in read_exr(tmp_path / "image.exr"))
    scene.view_layers[0].use_pass_vector = True
    ours = vectors(tmp_path)
    assert scene.frame_current_final == 5
    assert not ours[alpha == 0].any()
    shown.hide_render = True
    head.hide_render = False
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    theirs = vectors(tmp_path)
    covered = (alpha > 0.99) & theirs.any(axis=-1)
    assert covered.sum() > 200
    sizes = np.abs(theirs[covered]).mean(axis=0)
    assert sizes.min() > 0.5, "hardly anything moves"
    error = np.abs(ours - theirs)[covered]
    assert (np.median(error, axis=0) < 0.1 * sizes).all()
    assert (np.quantile(error, 0.9, axis=0) < 0.3 * sizes).all()


def test_software_graphics_leave_images_to_the_rasterizer(monkeypatch, tmp_path):
    """Catches images that take three times as long without a graphics card."""
    monkeypatch.undo()
    monkeypatch.setattr(engine, "has_gpu_context", lambda: True)
    monkeypatch.setattr(engine, "is_software", lambda: True)
    monkeypatch.setattr(engine, "draw_image", lambda *_: pytest.fail("drawn by the CPU's graphics"))
    avatar = driven()
    shown, head = show(avatar)
    assert_renders(tmp_path, avatar, head, expected_camera(camera_at(), shown))


def no_context():
    raise SystemError("GPU functions are not available")


def with_light(avatar):
    transfer, occlusion = transfer_of(avatar.neutral, avatar.faces, 32)
    radiance = uniform(np.full(3, 0.3)).astype(np.float32)
    roughness = np.where(avatar.neutral[:, 0] > 0, HAIR_ROUGHNESS, 0).astype(np.float32)
    light = AvatarLight(radiance, transfer, occlusion, transfer @ radiance, roughness, 0.05)
    return replace(avatar, light=light)


@pytest.mark.parametrize("device", ["GPU", "CPU"])
def test_light_of_the_scene(device, lighting, monkeypatch, tmp_path):
    """Catches another light or mode than the scene's, and pixels as recorded that change at all."""
    if device == "CPU":
        monkeypatch.setattr(engine, "SplatRenderer", no_context)
    avatar = textured(avatar_of("stga"))
    shown, head = show(avatar)
    camera_object = camera_at()
    unlit = render(tmp_path)
    for old in (shown, head):
        bpy.data.objects.remove(old)
    avatar = with_light(avatar)
    shown, head = show(avatar)
    sun = add_sun(4.0)
    recorded = render(tmp_path)
    assert unlit["A"].max() > 0.5
    for name, values in unlit.items():
        assert np.array_equal(recorded[name], values), name
    lighting.mode = "scene"
    lighting.exposure = 0.5
    camera = expected_camera(camera_object, shown)
    mesh = evaluated_vertices(head)
    shines = np.array(shown.matrix_world.inverted() @ sun.matrix_world)[:3, :3] @ [0, 0, -1]
    light = Light("sun", np.full(3, 4.0), direction=shines, angle=sun.data.angle)
    light = Lighting(lights=(light,), exposure=0.5)
    colors = Relighter(avatar).colors(mesh.astype(np.float64), camera.position, light)
    splats = replace(avatar.splats, sh=((colors - 0.5) / SH_C0)[:, None].astype(np.float32))
    expected = render_avatar(replace(avatar, splats=splats), mesh, camera, (0.0,) * 3)
    found = displayed(render(tmp_path), 0.0)
    error = np.abs(found - np.clip(expected, 0, 1))
    assert error.mean() < TOLERANCE / 4
    assert error.max() < (0.3 if device == "GPU" else 2 * TOLERANCE)  # edges of shadows
    assert np.abs(displayed(recorded, 0.0) - expected).mean() > 0.05


@pytest.mark.parametrize(
    "changes",
    [
        {"sensor_fit": "VERTICAL", "sensor_height": 20.0},
        {"sensor_fit": "HORIZONTAL", "shift_x": 0.2, "shift_y": -0.1},
        {"shift_x": -0.1, "shift_y": 0.15},
    ],
)
@pytest.mark.parametrize("portrait", [False, True])
def test_camera_settings_are_applied(changes, portrait, tmp_path):
    """Catches a wrong sensor fit, shifts' sign or unit, and the percentage."""
    scene = bpy.context.scene
    width, height = (HEIGHT, WIDTH) if portrait else (WIDTH, HEIGHT)
    scene.render.resolution_x = 2 * width
    scene.render.resolution_y = 2 * height
    scene.render.resolution_percentage = 50
    avatar = textured(avatar_of("stga"))
    shown, head = show(avatar)
    camera = expected_camera(camera_at(45.0, **changes), shown, width, height)
    assert assert_renders(tmp_path, avatar, head, camera).max() > 0.3


@pytest.mark.parametrize("crop", [False, True])
def test_render_region(crop, tmp_path):
    """Catches a render region that shifts the image."""
    show(textured(avatar_of("stga")))
    camera_at()
    whole = render(tmp_path)["R"]
    r = bpy.context.scene.render
    r.use_border = True
    r.use_crop_to_border = crop
    r.border_min_x = 0.3
    r.border_max_x = 0.71
    r.border_min_y = 0.2
    r.border_max_y = 0.77
    rows = slice(HEIGHT - int(0.77 * HEIGHT), HEIGHT - int(0.2 * HEIGHT))
    columns = slice(28, 68)
    part = render(tmp_path)["R"]
    assert whole[rows, columns].max() > 0.1
    part = part if crop else part[rows, columns]
    assert_allclose(part, whole[rows, columns], atol=1e-4)


@pytest.mark.parametrize("is_linked", [True, False])
def test_world_color_is_the_background(tmp_path, is_linked):
    """Catches a background blended in linear light, and one of a world without a shader."""
    scene = bpy.context.scene
    scene.render.film_transparent = False
    scene.world = bpy.data.worlds.new("world")
    scene.world.color = 0.6, 0.3, 0.1
    tree = enable_nodes(scene.world)
    background = tree.nodes["Background"].inputs
    if not is_linked:
        tree.links.clear()
    background["Color"].default_value = 0.4, 0.1, 0.2, 1
    background["Strength"].default_value = 0.5
    avatar = textured(avatar_of("stga"))
    shown, head = show(avatar)
    camera = expected_camera(camera_at(), shown)
    behind = (1.055 * np.array([0.2, 0.05, 0.1]) ** (1 / 2.4) - 0.055) * is_linked
    expected = render_avatar(avatar, evaluated_vertices(head), camera, tuple(behind))
    passes = render(tmp_path)
    assert passes["A"].min() == 1
    assert np.abs(displayed(passes, 0.0) - expected).max() < TOLERANCE


def test_depth_in_meters(tmp_path):
    """Catches distances instead of depth, and anything but Blender's 1e10 where nothing is."""
    two = splats_of([[-0.2, 0, 0], [0.3, 0, -1]], log_scale=np.log(0.03), opacity=9)
    show_world_splats(two, "two")
    active_camera((0, 0, 2))
    depth = render(tmp_path)["Depth"]
    assert (depth[:5] == 1e10).all()
    focal = 50 / 36 * WIDTH
    for x, z in ((-0.2, 2), (0.3, 3)):
        assert depth[HEIGHT // 2, int(WIDTH / 2 + focal * x / z)] == pytest.approx(z, abs=1e-5)


def test_display_settings_apply_to_renders(tmp_path):
    """Catches settings that only affect the viewport."""
    avatar = textured(avatar_of("stga"))
    unseen = np.arange(len(avatar.faces)) % 3 == 0
    shown, head = show(replace(avatar, regions={"unseen": unseen}))
    camera = expected_camera(camera_at(), shown)
    faint = 1 / (1 + np.exp(-avatar.splats.opacity)) < 0.5
    selected = np.zeros(len(avatar.faces), bool)
    selected[:60] = True
    vertices = np.unique(avatar.faces[selected])
    head.vertex_groups.new(name="stga_5").add(vertices.tolist(), 1.0, "REPLACE")
    frozen = ~np.isin(avatar.faces, vertices).all(1)[avatar.splats.face]
    constant = replace(avatar.splats, sh=avatar.splats.sh[:, :1])
    larger = replace(avatar.splats, log_scale=avatar.splats.log_scale + np.float32(np.log(2)))
    cases = {
        splat_nodes.OPACITY_THRESHOLD: (0.5, 0.0, avatar.splats.rows(~faint)),
        splat_nodes.SELECTED_ONLY: (True, False, avatar.splats.rows(~frozen)),
        splat_nodes.FILMED_ONLY: (True, False, avatar.splats.rows(~unseen[avatar.splats.face])),
        splat_nodes.VIEW_DEPENDENT: (False, True, constant),
        splat_nodes.SIZE: (2.0, 1.0, larger),
        splat_nodes.PERCENTAGE: (0.0, 100.0, avatar.splats.rows(np.zeros(3000, bool))),
    }
    for name, (value, default, splats) in cases.items():
        set_input(shown, name, value)
        assert_renders(tmp_path, replace(avatar, splats=splats), head, camera, what=name)
        set_input(shown, name, default)
    set_input(shown, splat_nodes.SHOW_SELECTION, True)
    gray = displayed(render(tmp_path), 0.0)
    colored = render_avatar(avatar, evaluated_vertices(head), camera, (0.0,) * 3)
    assert np.ptp(gray, axis=0).mean() < np.ptp(colored, axis=0).mean()


def test_only_visible_objects_are_rendered(tmp_path):
    """Catches hidden objects in the image, and missing collection instances."""
    shown = show_world_splats(splats_of(np.zeros((50, 3))), "scan")
    active_camera((0, 0, 1))
    assert render(tmp_path)["A"].max() > 0.5
    shown.hide_render = True
    assert render(tmp_path)["A"].max() == 0
    shown.hide_render = False
    collection = bpy.data.collections.new("away")
    bpy.context.scene.collection.objects.unlink(shown)
    collection.objects.link(shown)
    assert render(tmp_path)["A"].max() == 0
    instance = placed("instance", None)
    instance.instance_type = "COLLECTION"
    instance.instance_collection = collection
    instance.location = (0.2, 0, 0)
    alpha = render(tmp_path)["A"]
    assert alpha[:, : WIDTH // 2].max() == 0
    assert alpha[:, WIDTH // 2 :].max() > 0.5


def test_background_scenes_are_shown(tmp_path):
    """Catches splats of a background scene left out, where Cycles and EEVEE show them."""
    avatar = textured(avatar_of("stga"))
    shown, _ = show(avatar)
    camera = camera_at()
    expected = render(tmp_path)["A"]
    assert expected.max() > 0.5
    behind = bpy.context.scene
    multilayer(behind.render.image_settings)
    between = bpy.data.scenes.new("between")
    main = behind.copy()
    for child in (*main.collection.objects, *main.collection.children):
        kind = "objects" if isinstance(child, bpy.types.Object) else "children"
        getattr(main.collection, kind).unlink(child)
    between.background_set = behind
    main.background_set = between
    main.camera = camera
    main.render.filepath = str(tmp_path / "main.exr")
    bpy.ops.render.render(write_still=True, scene=main.name)
    assert_allclose(read_passes(tmp_path / "main.exr")["A"], expected, atol=TOLERANCE)
    shown.hide_render = True
    bpy.ops.render.render(write_still=True, scene=main.name)
    assert read_passes(tmp_path / "main.exr")["A"].max() == 0


@pytest.mark.parametrize("device", ["CPU", "GPU"])
def test_clip_distances_of_the_camera(device, monkeypatch, tmp_path):
    """Catches splats nearer or farther than the camera's clip distances, keyframed too."""
    if device == "CPU":
        monkeypatch.setattr(engine, "has_gpu_context", lambda: False)
    places = [(x, 0, -z) for x, z in ((-0.3, 1), (0, 2), (0.3, 3))]
    show_world_splats(splats_of(places, log_scale=np.log(0.03)), "three")
    camera = active_camera((0, 0, 0))
    for start, end, seen in ((0.1, 100, "111"), (1.5, 100, "011"), (0.1, 2.5, "110")):
        camera.data.clip_start = start
        camera.data.clip_end = end
        for name in ("clip_start", "clip_end"):
            camera.data.keyframe_insert(name, frame=1)
        alpha = render(tmp_path)["A"]
        pixel = [int(WIDTH * (0.5 + 50 / 36 * x / -z)) for x, _, z in places]
        found = "".join(str(int(alpha[HEIGHT // 2, each] > 0.3)) for each in pixel)
        assert found == seen


def test_animation(tmp_path):
    """Catches splats that stay where they were, and a keyframed *Disable in Renders* ignored."""
    shown, _ = show(textured(avatar_of("stga")))
    camera_at()
    for frame, hidden in ((1, False), (5, True), (9, False)):
        shown.hide_render = hidden
        shown.keyframe_insert("hide_render", frame=frame)
    scene = bpy.context.scene
    scene.frame_start = 1
    scene.frame_end = 9
    scene.frame_step = 4
    multilayer(scene.render.image_settings)
    scene.render.filepath = str(tmp_path / "image_####.exr")
    bpy.ops.render.render(animation=True)
    first, hidden, last = (read_passes(tmp_path / f"image_{n:04d}.exr")["A"] for n in (1, 5, 9))
    assert (first.max() > 0.5, hidden.max(), last.max() > 0.5) == (True, 0, True)
    assert np.abs(first - last).max() > 0.1


@pytest.mark.needs("adapter")
def test_webgpu_renders_where_blender_has_no_gpu_context(tmp_path, monkeypatch):
    """Catches F12 on the CPU where preferences say GPU, and a silent failure."""
    from raster import gpu_device

    from stga_addon.raster.gpu import compose as on_gpu

    monkeypatch.setattr(engine, "draw_image", lambda *_: None)
    wanted = ["cpu"]
    engine.unregister()
    engine.register(no_python, lambda: wanted[0])
    show(textured(avatar_of("stga"), -6))
    camera_at()
    on_cpu = render(tmp_path)
    wanted[0] = f"gpu:{gpu_device.device().name}"
    passes = render(tmp_path)
    assert engine._rasterizer._composer.device == wanted[0]
    for channel in "RGBA":
        assert_allclose(passes[channel], on_cpu[channel], atol=1e-4)
    seen = on_cpu["A"] > 0.05
    assert seen.any()
    assert_allclose(passes["Depth"][seen], on_cpu["Depth"][seen], rtol=1e-3)

    def lost(*_):
        raise DeviceError("Card 9000 was lost", "try again")

    monkeypatch.setattr(on_gpu, "compose", lost)
    with failure("Card 9000 was lost; try again"):
        render(tmp_path)


def test_what_cannot_be_rendered_is_named():
    """Catches an image of another camera, splats scattered over an edited mesh, and a traceback."""
    shown, head = show(avatar_of("stga", 10))
    with failure("no camera"):
        bpy.ops.render.render()
    camera = camera_at()
    for kind in ("ORTHO", "PANO"):
        camera.data.type = kind
        with failure("camera: is not a perspective camera"):
            bpy.ops.render.render()
    camera.data.type = "PERSP"
    bpy.context.view_layer.objects.active = head
    bpy.ops.object.mode_set(mode="EDIT")
    with refusal("head: is in Edit Mode; head splats is drawn again when you leave it"):
        shown_layers()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len(shown_layers()) == 1
    for kind in ("SUBSURF", "EDGE_SPLIT"):
        changed = head.modifiers.new("other", kind)
        if kind == "EDGE_SPLIT":
            changed.split_angle = 0.0
        with failure("head: has other triangles than head splats"):
            bpy.ops.render.render()
        head.modifiers.remove(changed)
    set_input(shown, splat_nodes.HEAD, None)
    with failure("has no head to follow"):
        bpy.ops.render.render()


@pytest.mark.parametrize("stage", ["all_layers", "combined"])
@pytest.mark.parametrize("raised", [StgaError("head: is broken"), MemoryError("of pixels")])
def test_failed_render_is_an_error_and_an_empty_image(stage, raised, tmp_path, monkeypatch):
    """Catches an image without passes, and a failure saved as an image."""

    def fail(*_):
        raise raised

    scene = bpy.context.scene
    scene.render.filepath = str(tmp_path / "failed.png")
    camera_at()
    monkeypatch.setattr(engine, stage, fail)
    message = "^Error: head: is broken$"
    if isinstance(raised, MemoryError):
        message = r"Unexpected error \(MemoryError: of pixels\); see the console"
    with failure(message) as reported:
        bpy.ops.render.render(write_still=True)
    assert str(reported.value).count(str(raised)) == 1
    assert not any(tmp_path.iterdir())
    multilayer(scene.render.image_settings)
    bpy.data.images["Render Result"].save_render(str(tmp_path / "empty.exr"))
    passes = read_exr(tmp_path / "empty.exr")
    combined = [values for name, values in passes.items() if "Combined" in name]
    assert len(combined) == 4
    assert all(values.shape == (HEIGHT, WIDTH) and not values.any() for values in combined)


@pytest.mark.parametrize("mode", ["OFFAXIS", "PARALLEL", "MULTIVIEW"])
def test_stereo(tmp_path, mode):
    """Catches two equal pictures, eyes that are swapped, and convergence at another distance."""
    avatar = textured(avatar_of("stga"))
    shown, head = show(avatar)
    camera = camera_at()
    render_settings = bpy.context.scene.render
    stereo = camera.data.stereo
    stereo.interocular_distance = 0.065
    stereo.convergence_distance = 0.9
    stereo.pivot = "LEFT"
    bpy.context.view_layer.update()
    right = camera.copy()
    right.data = camera.data.copy()
    right.matrix_world = camera.matrix_world @ Matrix.Translation((0.065, 0, 0))
    bpy.context.scene.collection.objects.link(right)
    render_settings.use_multiview = True
    render_settings.views_format = "STEREO_3D"
    if mode == "MULTIVIEW":
        render_settings.views_format = mode
        camera.name = "eye_L"
        right.name = "eye_R"
        right.data.lens = 50
    else:
        stereo.convergence_mode = mode
    image = render_settings.image_settings
    multilayer(image)
    image.views_format = "INDIVIDUAL"
    render_settings.filepath = str(tmp_path / "image.exr")
    bpy.ops.render.render(write_still=True)
    expected = {"L": expected_camera(camera, shown), "R": expected_camera(right, shown)}
    if mode == "OFFAXIS":  # what is at the convergence distance is at the same pixel
        eye = expected["R"]
        expected["R"] = replace(eye, cx=eye.cx + eye.fl_x * 0.065 / 0.9)
    vertices = evaluated_vertices(head)
    for view, seen_by in expected.items():
        wanted = render_avatar(avatar, vertices, seen_by, (0.0, 0.0, 0.0))
        assert wanted.max() > 0.3, "nothing to compare"
        found = displayed(read_passes(tmp_path / f"image_{view}.exr"), 0.0)
        assert np.abs(found - np.clip(wanted, 0, 1)).max() < 2 * TOLERANCE


def veil_before(camera):
    """World splats, half transparent, nearer to the camera than a head, which cover it in part."""
    xyz = [camera.matrix_world @ Vector((x, 0.0, -0.3)) for x in (-0.03, 0.0, 0.03)]
    return show_world_splats(splats_of(xyz, log_scale=np.log(0.01)), "veil")


@pytest.mark.parametrize("transparent", [True, False])
def test_collections_of_holdouts_and_of_indirect_light(tmp_path, transparent):
    """Catches splats drawn that mask others, or that the camera does not see; and what is covered
    in part darkened twice."""
    shown, _ = show(textured(avatar_of("stga")))
    camera_at()
    scene = bpy.context.scene
    layer = bpy.context.view_layer
    bpy.context.view_layer.update()
    front = veil_before(scene.camera)
    masks = bpy.data.collections.new("masks")
    scene.collection.children.link(masks)
    masks.objects.link(front)
    scene.collection.objects.unlink(front)
    scene.render.film_transparent = True
    front.hide_render = True
    behind = render(tmp_path)
    front.hide_render = False
    shown.hide_render = True
    before = render(tmp_path)
    shown.hide_render = False
    both = render(tmp_path)
    scene.render.film_transparent = transparent
    place = layer.layer_collection.children["masks"]
    place.holdout = True
    masked = render(tmp_path)
    assert 0.2 < before["A"].max() < 0.98
    if transparent:
        assert_allclose(masked["A"], behind["A"] * (1 - before["A"]), atol=TOLERANCE)
        is_seen = masked["A"] > 0.1
        for channel in "RGB":
            straight = [each[channel] / np.maximum(each["A"], 1e-6) for each in (masked, behind)]
            assert_allclose(straight[0][is_seen], straight[1][is_seen], atol=0.02)
    else:
        assert_allclose(masked["A"], 1 - before["A"], atol=TOLERANCE)
        place.holdout = False
        whole = render(tmp_path)
        empty = before["A"] == 0
        assert empty.any()
        assert_array_equal(masked["R"][empty], whole["R"][empty])
        return
    place.holdout = False
    front.is_holdout = True
    assert_array_equal(render(tmp_path)["A"], masked["A"])
    front.is_holdout = False
    place.indirect_only = True
    assert_array_equal(render(tmp_path)["A"], behind["A"])
    place.indirect_only = False
    front.visible_camera = False
    assert_array_equal(render(tmp_path)["A"], behind["A"])
    front.visible_camera = True
    assert_array_equal(render(tmp_path)["A"], both["A"])


@pytest.mark.skipif(not compat.NATIVE_SPLATS, reason="Blender before 5.3 has no native splats")
def test_native_splats_of_others_are_sorted_among_ours(tmp_path):
    """Catches a room or a prop that the image lacks, stands elsewhere, hides what is before it, or
    stays as it was once it is edited."""
    splats = random_splats(1, 60, degree=1, extent=0.15)
    splats = replace(splats, log_scale=splats.log_scale + 3.5, opacity=splats.opacity + 1)
    whole = show_world_splats(splats, "all")
    active_camera((0, -1, 0)).rotation_euler = (np.pi / 2, 0, 0)
    expected = render(tmp_path)
    assert expected["A"].max() > 0.8
    bpy.data.objects.remove(whole)
    write_ply(tmp_path / "others.ply", splats.rows(np.arange(0, 60, 2)))
    bpy.ops.wm.ply_import(filepath=str(tmp_path / "others.ply"))
    others = bpy.context.object
    assert render(tmp_path)["A"].max() > 0.5
    show_world_splats(splats.rows(np.arange(1, 60, 2)), "ours")
    both = render(tmp_path)
    for name, values in both.items():
        assert_allclose(values, expected[name], rtol=1e-4, atol=1e-4)
    cache = SplatCache()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    bpy.app.handlers.depsgraph_update_post.append(lambda _, graph: cache.scene_changed(graph))
    (before,) = native_layers(depsgraph, cache)
    (again,) = native_layers(depsgraph, cache)
    assert again.splats is before.splats
    others.data.points[0].co.x += 1
    others.data.update_tag()
    bpy.context.view_layer.update()
    bpy.app.handlers.depsgraph_update_post.pop()
    (after,) = native_layers(depsgraph, cache)
    assert after.splats.xyz[0, 0] == pytest.approx(before.splats.xyz[0, 0] + 1)
