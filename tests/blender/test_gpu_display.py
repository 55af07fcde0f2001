"""The GPU display without a window: what it draws, from where, and what it leaves."""

import bpy
import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.avatar.embedding import WORLD, to_world
from stga_addon.capture.camera import look_at
from stga_addon.scene.display.splat_attributes import avatar_attributes
from stga_addon.scene.display.splat_nodes import POINTS
from stga_addon.scene.display.splat_object import (
    display_mode,
    show_world_splats,
    update_splats,
)
from stga_addon.scene.gpu.packing import (
    StaticSplats,
    View,
    drawing_order,
    frame_block,
    posed_frames,
)
from stga_addon.scene.layers import SceneLayer
from stga_addon.scene.render import viewport_display
from stga_addon.scene.render.scene_splats import SplatCache
from stga_addon.scene.render.viewport_display import GpuDisplay, region_view

from .session import point_clouds, save, shown_layers
from .test_splat_object import FRAMES, avatar_of, random_splats, show_on_head


class Region:
    """A RegionView3D one meter before the origin, looking along −z."""

    def __init__(self, is_perspective):
        from mathutils import Matrix

        near = 0.1
        far = 10.0
        f = 2.0
        self.is_perspective = is_perspective
        self.use_clip_planes = False
        self.view_matrix = Matrix.Translation((0, 0, -1))
        depth = np.array([-(far + near), -2 * far * near] if is_perspective else [-2, -far - near])
        last = (0, 0, -1, 0) if is_perspective else (0, 0, 0, 1)
        x, y = ((0.1, 0), (-0.2, 0)) if is_perspective else ((0, 0.1), (0, -0.2))  # off the middle
        depth = depth / (far - near)
        self.window_matrix = Matrix(((f, 0, *x), (0, 1.3 * f, *y), (0, 0, *depth), last))


@pytest.mark.parametrize("is_perspective", [True, False])
def test_depth_of_a_view(is_perspective):
    """Catches splats beside where Blender draws them, wrong occlusion, and another clip range."""
    region = Region(is_perspective)
    view, (a, b, c, d) = region_view(region, 300, 200)
    point = np.array([0.05, 0.02, -0.4, 1.0])
    clip = np.array(region.window_matrix) @ np.array(region.view_matrix) @ point
    (pixel,), (z,) = view.camera.project(point[None, :3])
    assert (a + b * z) / (c + d * z) == pytest.approx(clip[2] / clip[3], abs=1e-6)
    expected = [(clip[0] / clip[3] + 1) * 150, (1 - clip[1] / clip[3]) * 100]
    assert pixel == pytest.approx(expected, abs=0.2)
    back = z - 1.4
    assert (view.near, view.far) == pytest.approx((0.1 + back, 10 + back), rel=1e-5)


@pytest.mark.parametrize("distance", [0.5, 2.0, 1000.0])
@pytest.mark.parametrize("spread", [0.2, 400.0])
@pytest.mark.parametrize("short_keys", [False, True])
def test_drawing_order(distance, spread, short_keys):
    """Catches splats out of order, by keys of either length, and those behind the camera."""
    rng = np.random.default_rng(1)
    splats = random_splats(1, 3000)
    xyz = rng.normal(0, spread / 4, (3000, 3)).astype(np.float32)
    object.__setattr__(splats, "xyz", xyz)
    layer = SceneLayer(splats, WORLD, np.eye(4))
    view = View(look_at((0, 0, distance), (0, 0, 0), 100, 100, 100))
    static = StaticSplats([layer])
    frames = posed_frames([layer], [frame_block(WORLD)], view)
    order = drawing_order(static, frames, view, short_keys).astype(int)
    depth = distance - xyz[:, 2].astype(np.float64)
    assert sorted(order) == sorted(np.flatnonzero(depth >= view.near))
    assert order[0] == depth.argmax(), "the largest sort key overflows"
    allowed = short_keys * 1e-5 * depth[order].min(), 1e-6 * np.abs(depth).max()
    assert np.diff(depth[order]).max() <= max(allowed)


def test_the_cache_follows_new_splats():
    """Catches splats of an earlier training state."""
    avatar = avatar_of("stga")
    shown, _ = show_on_head(avatar)
    cache = SplatCache()
    shown_layers(cache)
    moved = avatar.splats.xyz + 1
    object.__setattr__(avatar.splats, "xyz", moved)
    update_splats(shown, avatar_attributes(avatar))
    (layer,) = shown_layers(cache)
    assert np.array_equal(layer.splats.xyz, moved)


def test_an_error_ends_the_display(monkeypatch, capsys):
    """Catches points over the GPU's picture, an error in every redraw, and splats gone for good."""
    shown = show_world_splats(random_splats(1, 10), "scan")
    assert not point_clouds()
    display = GpuDisplay()
    monkeypatch.setattr(viewport_display, "display", display)
    monkeypatch.setattr(display, "_draw_region", lambda context: 1 / 0)
    display._draw()
    assert display.failed
    assert "ZeroDivisionError" in display.problem
    assert capsys.readouterr().out.count("STGA:") == 1
    viewport_display.show_points()
    assert display_mode(shown) == POINTS
    assert point_clouds()
    bpy.app.timers.unregister(viewport_display.show_points)


def positions(layer):
    """(N, 3) world positions of the layer's splats."""
    local = to_world(layer.splats, layer.frames).xyz
    return local @ layer.to_world[:3, :3].T + layer.to_world[:3, 3]


def shown_at(frame, cache):
    """World positions of the one visible layer."""
    bpy.context.scene.frame_set(frame)
    (layer,) = shown_layers(cache)
    return positions(layer)


@pytest.fixture
def library(tmp_path):
    """A .blend file with a moving head and splats in "anna", and their places at FRAMES."""
    avatar = avatar_of("stga", 300)
    shown, head = show_on_head(avatar)
    collection = bpy.data.collections.new("anna")
    bpy.context.scene.collection.children.link(collection)
    for thing in (head.parent, head, shown):
        bpy.context.scene.collection.objects.unlink(thing)
        collection.objects.link(thing)
    expected = [shown_at(frame, SplatCache()) for frame in FRAMES]
    assert np.abs(expected[0] - expected[1]).max() > 1e-3, "the head does not move"
    save(tmp_path / "library.blend")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return tmp_path / "library.blend", expected


def linked_collection(path):
    with bpy.data.libraries.load(str(path), link=True) as (_, target):
        target.collections = ["anna"]
    return target.collections[0]


@pytest.mark.parametrize("is_instance", [False, True])
def test_linked_heads_are_followed(library, is_instance):
    """Catches linked or instanced splats that are missing, stand still, or are elsewhere."""
    path, expected = library
    scene = bpy.context.scene
    cache = SplatCache()
    linked = linked_collection(path)
    if is_instance:
        instance = bpy.data.objects.new("anna", None)
        instance.instance_type = "COLLECTION"
        instance.instance_collection = linked
        instance.location = (1, 2, 3)
        instance.scale = (2, 2, 2)
        scene.collection.objects.link(instance)
    else:
        scene.collection.children.link(linked)
    for frame, there in zip(FRAMES, expected, strict=True):
        placed = 2 * there + [1, 2, 3] if is_instance else there
        assert_allclose(shown_at(frame, cache), placed, atol=1e-5)


def test_overridden_heads_are_followed(library):
    """Catches splats of an override that follow the library's head."""
    path, expected = library
    scene = bpy.context.scene
    linked = linked_collection(path)
    scene.collection.children.link(linked)
    linked.override_hierarchy_create(scene, bpy.context.view_layer)
    if linked.name in scene.collection.children:
        scene.collection.children.unlink(linked)
    things = bpy.context.view_layer.objects
    own = {thing.name: thing for thing in things if thing.override_library is not None}
    assert set(own) == {"root", "head", "head splats"}
    cache = SplatCache()
    for frame, positions_there in zip(FRAMES, expected, strict=True):
        assert_allclose(shown_at(frame, cache), positions_there, atol=1e-6)
    own["root"].location = (0.5, 0, 0)
    assert_allclose(shown_at(FRAMES[0], cache), expected[0] + [0.5, 0, 0], atol=1e-6)
    own["head"].scale = (2, 2, 2)  # and its splats, which stay where they are, follow its surface
    there = shown_at(FRAMES[0], cache) - [0.5, 0, 0]
    assert_allclose(np.ptp(there, axis=0), 2 * np.ptp(expected[0], axis=0), rtol=0.01)
