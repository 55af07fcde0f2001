"""What a redraw asks of the scene's objects, and what is kept between redraws."""

from types import SimpleNamespace

import bpy
import numpy as np

from stga_addon.scene import tags, vertex_groups
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import set_input
from stga_addon.scene.render.scene_splats import SplatCache, visible_layers

from .session import shown_layers
from .test_splat_object import avatar_of, show_on_head


class PlainObject:
    """An object that shows no splats: nothing else may be asked of it."""

    instance_type = "NONE"

    def get(self, name):
        assert name == tags.KIND


def shown_avatar():
    avatar = avatar_of("stga", count=50)
    return show_on_head(avatar)


def test_objects_without_splats_are_not_asked():
    """Catches redraws that take the longer the more objects a scene has, with or without an
    avatar in the file."""
    unread = SimpleNamespace(mode="VIEWPORT")
    assert visible_layers(unread, SplatCache(), SimpleNamespace()) == []
    shown_avatar()
    view_layer = SimpleNamespace(objects=[PlainObject()] * 3)
    plain = SimpleNamespace(view_layer=view_layer, scene=SimpleNamespace(background_set=None))
    assert visible_layers(plain, SplatCache(), SimpleNamespace()) == []
    layer = SimpleNamespace(exclude=False, children=())
    layer.collection = SimpleNamespace(hide_render=False, objects=[PlainObject()])
    plain.view_layer.layer_collection = layer
    assert visible_layers(plain, SplatCache()) == []


def test_a_render_while_an_extension_is_enabled(monkeypatch):
    """Catches a render that ends in the middle: Blender hides the file's data meanwhile."""
    from _bpy_restrict_state import _data_restrict

    shown_avatar()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    monkeypatch.setattr(bpy, "data", _data_restrict)
    assert len(visible_layers(depsgraph, SplatCache())) == 1


def test_a_selection_is_read_once(monkeypatch):
    """Catches vertex groups read at every redraw, and what was painted, removed or is another
    frame's not shown."""
    shown, head = shown_avatar()
    set_input(shown, splat_nodes.SHOW_SELECTION, True)
    faces = np.array([polygon.vertices[:] for polygon in head.data.polygons])
    for timestep, chosen in ((5, faces[:9]), (6, faces[20:40])):
        group = head.vertex_groups.new(name=tags.group_name(timestep))
        group.add(np.unique(chosen).tolist(), 1.0, "REPLACE")
    scene = bpy.context.scene
    cache = SplatCache()
    reads = list[object]()
    read_faces = vertex_groups._read_faces
    monkeypatch.setattr(
        vertex_groups, "_read_faces", lambda *given: reads.append(given) or read_faces(*given)
    )

    def frozen():
        (layer,) = shown_layers(cache)
        fresh = vertex_groups.frame_selection(head, scene.frame_current)
        reads.pop() if fresh is not None else None
        assert (layer.frozen is None) == (fresh is None)
        assert fresh is None or (layer.frozen == ~fresh).all()
        return layer.frozen

    def changed(_, depsgraph):
        cache.scene_changed(depsgraph)

    bpy.app.handlers.depsgraph_update_post.append(changed)
    try:
        scene.frame_set(5)
        for _ in range(4):
            frozen()
        assert len(reads) == 1
        before = frozen()
        head.vertex_groups["stga_5"].add(faces[50].tolist(), 1.0, "REPLACE")
        bpy.context.view_layer.update()
        assert (frozen() != before).any()
        scene.frame_set(6)
        frozen()
        head.vertex_groups.remove(head.vertex_groups["stga_5"])
        frozen()
        scene.frame_set(5)
        assert frozen() is None
        head.vertex_groups.remove(head.vertex_groups["stga_6"])
        head.vertex_groups.new(name="stga_5").add(faces[60].tolist(), 1.0, "REPLACE")
        bpy.context.view_layer.update()
        assert (~frozen()).any()
    finally:
        bpy.app.handlers.depsgraph_update_post.remove(changed)
