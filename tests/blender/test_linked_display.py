"""What display and engine draw of heads in other files: linked, instanced, overridden."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from stga_addon.avatar.embedding import to_world
from stga_addon.scene.display.splat_object import show_avatar
from stga_addon.scene.layers import SceneLayer
from stga_addon.scene.render.scene_splats import SplatCache, visible_layers

from .test_splat_object import FRAMES, animated_head, avatar_of


def positions(layer: SceneLayer) -> np.ndarray:
    """(N, 3) world positions of the layer's splats."""
    local = to_world(layer.splats, layer.frames).xyz
    return local @ layer.to_world[:3, :3].T + layer.to_world[:3, 3]


def shown_at(frame: int, cache: SplatCache) -> np.ndarray:
    """World positions of the one visible layer."""
    bpy.context.scene.frame_set(frame)
    (layer,) = visible_layers(bpy.context.evaluated_depsgraph_get(), cache)
    return positions(layer)


@pytest.fixture
def library(tmp_path: Path) -> tuple[Path, list[np.ndarray]]:
    """A .blend file with a moving head and splats in "anna", and their places at FRAMES."""
    avatar = avatar_of("stga", 300)
    head = animated_head(avatar.neutral, avatar.faces)
    shown = show_avatar(avatar, head)
    collection = bpy.data.collections.new("anna")
    bpy.context.scene.collection.children.link(collection)
    for thing in (head.parent, head, shown):
        bpy.context.scene.collection.objects.unlink(thing)
        collection.objects.link(thing)
    expected = [shown_at(frame, SplatCache()) for frame in FRAMES]
    assert np.abs(expected[0] - expected[1]).max() > 1e-3, "the head does not move"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return tmp_path / "library.blend", expected


def linked_collection(path: Path):
    with bpy.data.libraries.load(str(path), link=True) as (_, target):
        target.collections = ["anna"]
    return target.collections[0]


@pytest.mark.parametrize("is_instance", [False, True])
def test_linked_heads_are_followed(library, is_instance):
    """Catches linked or instanced splats that are missing, stand still, need their own file, or are
    at the place of the collection."""
    path, expected = library
    scene, cache, linked = bpy.context.scene, SplatCache(), linked_collection(path)
    if is_instance:
        instance = bpy.data.objects.new("anna", None)
        instance.instance_type, instance.instance_collection = "COLLECTION", linked
        instance.location, instance.scale = (1, 2, 3), (2, 2, 2)
        scene.collection.objects.link(instance)
    else:
        scene.collection.children.link(linked)
    for frame, there in zip(FRAMES, expected, strict=True):
        placed = 2 * there + [1, 2, 3] if is_instance else there
        np.testing.assert_allclose(shown_at(frame, cache), placed, atol=1e-5)


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
        np.testing.assert_allclose(shown_at(frame, cache), positions_there, atol=1e-6)
    own["root"].location = (0.5, 0, 0)
    np.testing.assert_allclose(shown_at(FRAMES[0], cache), expected[0] + [0.5, 0, 0], atol=1e-6)
    own["head"].scale = (2, 2, 2)  # and its splats, which stay where they are, follow its surface
    there = shown_at(FRAMES[0], cache) - [0.5, 0, 0]
    np.testing.assert_allclose(np.ptp(there, axis=0), 2 * np.ptp(expected[0], axis=0), rtol=0.01)
