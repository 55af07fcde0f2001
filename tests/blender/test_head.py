"""The imported head against the capture's own meshes."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusal import refusal

from stga_addon.errors import StgaError
from stga_addon.scene import tags
from stga_addon.scene.compat import SLOTTED_ACTIONS
from stga_addon.scene.rig.head import import_head

from .captures import at_frame, flame_model, flame_sequence, mesh_capture, motion_capture
from .session import open_file, save


def block_counts():
    kinds = ("objects", "meshes", "shape_keys", "actions", "armatures", "collections")
    return {kind: len(getattr(bpy.data, kind)) for kind in kinds}


def test_each_frame_evaluates_to_its_timestep(tmp_path):
    """Fails when a key is off by a frame, leaks into others, or is not saved."""
    capture = mesh_capture(tmp_path, timesteps=(2, 3, 7, 8))
    head = import_head(capture)
    if SLOTTED_ACTIONS:  # their layers are what artists see
        (layer,) = head.data.shape_keys.animation_data.action.layers
        assert layer.name == "Layer"
    save(tmp_path / "head.blend")
    name = head.name
    open_file(tmp_path / "head.blend")
    head = bpy.data.objects[name]
    mesh = capture.mesh
    expected = {timestep: mesh(timestep) for timestep in capture.timesteps}
    expected |= {6: mesh(3) / 4 + mesh(7) * 3 / 4, 2.5: (mesh(2) + mesh(3)) / 2}
    for frame, vertices in (expected | {-5: mesh(2), 30: mesh(8)}).items():
        assert_allclose(at_frame(head, frame), vertices, atol=1e-7)


def test_axes_faces_and_regions(tmp_path):
    """Fails when y up does not become z up, or the head is mirrored on the way, when faces are
    re-ordered or turned, regions are lost, a second capture replaces the first, and when one of a
    single timestep has no keyframe that keeps its mesh."""
    capture = mesh_capture(tmp_path / "anna", timesteps=(5,))
    head = import_head(capture)
    bpy.context.view_layer.update()
    turned = np.array(head.matrix_world)[:3, :3]
    assert_allclose(turned @ [0, 1, 0], [0, 0, 1], atol=1e-6)
    assert_allclose(turned @ [1, 0, 0], [1, 0, 0], atol=1e-6)
    assert np.linalg.det(turned) == pytest.approx(1)
    assert head.parent.name == "anna"
    assert "anna" in bpy.data.collections
    mesh = head.data
    assert [list(polygon.vertices) for polygon in mesh.polygons] == capture.faces.tolist()
    members = [element.value for element in mesh.attributes[tags.REGION_PREFIX + "mouth"].data]
    assert members == capture.regions["mouth"].tolist()
    other = import_head(mesh_capture(tmp_path / "other"))
    assert other != head
    assert other.parent != head.parent
    for frame in (0, 5, 9):
        assert_allclose(at_frame(head, frame), capture.mesh(5), atol=1e-7)


def test_second_import_replaces_the_first(tmp_path):
    """Fails when a second import duplicates or keeps the head or its rig, or breaks references."""
    first = import_head(mesh_capture(tmp_path))
    first.modifiers.new("artist's own", "SMOOTH").iterations = 0
    follower = bpy.data.objects.new("follower", None)
    follower.parent = first
    counts = block_counts()
    bpy.context.view_layer.objects.active = first
    bpy.ops.object.mode_set(mode="EDIT")
    same_triangles = mesh_capture(tmp_path, seed=4)
    assert_allclose(at_frame(import_head(same_triangles), 3), same_triangles.mesh(3), atol=1e-7)
    assert first.mode == "OBJECT"
    changed = mesh_capture(tmp_path, timesteps=(1, 2), vertices=70, seed=3)
    second = import_head(changed)
    assert second == first == follower.parent
    assert block_counts() == counts
    assert [modifier.name for modifier in second.modifiers] == ["artist's own"]
    assert_allclose(at_frame(second, 2), changed.mesh(2), atol=1e-7)
    assert list(second[tags.TIMESTEPS]) == [1, 2]
    source = tmp_path / "capture"
    import_head(motion_capture(flame_sequence(flame_model()), source))
    capture = mesh_capture(source)
    head = import_head(capture)
    assert not bpy.data.armatures
    assert not head.modifiers
    assert_allclose(at_frame(head, 3), capture.mesh(3), atol=1e-7)


def test_unreadable_timestep_leaves_the_scene_unchanged(tmp_path):
    """Fails when a mesh that cannot be read leaves a partly imported head in the scene."""
    capture = mesh_capture(tmp_path)

    def mesh(timestep):
        if timestep == 7:
            raise StgaError("00007.obj: is truncated")
        return capture.mesh(timestep)

    before = block_counts()
    with refusal("truncated"):
        import_head(replace(capture, mesh=mesh))
    assert block_counts() == before
