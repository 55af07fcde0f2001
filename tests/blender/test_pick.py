"""A click on what the viewport shows of an avatar; the window tests make a real one."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from stga_addon.scene import tags
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.objects import Identity

from .session import panel, placed
from .test_operators import show_ball

SIZE = (400, 300)


@pytest.fixture
def view(head, tmp_path):
    """The context of a viewport that looks at an avatar, and the point where that is seen."""
    show_ball(tmp_path / "avatar.npz")
    layer = bpy.context.view_layer
    root = head.parent
    root.location = (0.5, 0.25, 0)
    layer.update()
    points = [head.matrix_world @ point.co for point in head.data.vertices]
    middle = sum(points, points[0] * 0) / len(points)
    seen = Matrix.Translation(middle) @ Matrix.Translation((0, 0, 2))
    window = Matrix.Identity(4)
    window[2] = (0, 0, -1.0002, -0.02)
    window[3] = (0, 0, -1, 0)
    view_matrix = seen.inverted()
    rv3d = SimpleNamespace(
        perspective_matrix=window @ view_matrix, view_matrix=view_matrix, is_perspective=True
    )
    context = SimpleNamespace(
        scene=bpy.context.scene,
        view_layer=layer,
        region=SimpleNamespace(width=SIZE[0], height=SIZE[1]),
        region_data=rv3d,
        evaluated_depsgraph_get=bpy.context.evaluated_depsgraph_get,
    )
    assert len(evaluated_vertices(head))
    return context, np.array(SIZE) / 2, middle


def test_a_click_finds_what_moves_the_avatar(extension, head, view):
    """Catches a click on an avatar that selects nothing, one beside it or on a mesh before it that
    selects it, and parts that G takes away from each other."""
    context, middle, place = view
    pick = extension.operators.pick
    assert pick.avatar_at(context, middle) == head.parent
    assert pick.avatar_at(context, np.array([1.0, 1.0])) is None
    bpy.ops.mesh.primitive_cube_add(size=0.1, location=place + place.__class__((0, 0, 1)))
    context.view_layer.update()
    assert pick.avatar_at(context, middle) is None
    splats = panel().splats
    bpy.context.object.hide_set(True)
    splats.modifiers.clear()  # and no traceback
    assert pick.avatar_at(context, middle) is None
    for part in (head, splats):
        assert all((*part.lock_location, *part.lock_rotation, *part.lock_scale))
    assert not any(head.parent.lock_location)


def test_the_click_selects_it(extension, head, view):
    """Catches a camera that Blender has found there and that the avatar takes the selection of, and
    splats that stay selected, which G does not move."""
    objects = bpy.context.view_layer.objects
    splats = panel().splats
    root = head.parent
    identity = Identity(root)
    camera = placed("eye", bpy.data.cameras.new("eye"))
    for found, extend, expected in (
        ((), False, {root}),
        ((splats,), False, {root}),
        ((camera,), False, {camera}),
        ((camera,), True, {camera, root}),
    ):
        for each in objects:
            each.select_set(each in found)
        extension.operators.pick._select(identity, extend)
        assert set(objects.selected) == expected
    assert objects.active.get(tags.KIND) == tags.ROOT
