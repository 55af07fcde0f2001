"""Selections written as vertex groups and read back."""

import bpy
import numpy as np
import pytest

from stga_addon.errors import StgaError
from stga_addon.scene import tags
from stga_addon.scene.arrays import evaluated_vertices, mesh_triangles, read_values
from stga_addon.scene.rig.head import import_head
from stga_addon.scene.vertex_groups import read_selection, write_selection

from .captures import closure, flame_model, flame_sequence, mesh_capture, motion_capture


@pytest.fixture
def capture(tmp_path):
    return mesh_capture(tmp_path, timesteps=(2, 3, 7))


@pytest.fixture
def head(capture):
    return import_head(capture)


def random_selection(capture, share: float = 0.2, seed: int = 0) -> dict[int, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {timestep: rng.random(len(capture.faces)) < share for timestep in capture.timesteps}


def test_reading_back_gives_the_closure(capture, head):
    """Fails when a group has another frame or vertices, or leaks into another, and when each round
    trip grows the selection, or adds groups beside the old ones."""
    chosen = random_selection(capture)
    write_selection(head, chosen)
    read = read_selection(head)
    assert list(read) == [2, 3, 7]
    for timestep, selected in chosen.items():
        np.testing.assert_array_equal(read[timestep], closure(selected, capture.faces))
        assert (read[timestep] >= selected).all()
    names = sorted(group.name for group in head.vertex_groups)
    write_selection(head, read)
    assert sorted(group.name for group in head.vertex_groups) == names
    np.testing.assert_equal(read_selection(head), read)


def test_new_selection_replaces_only_selection_groups(tmp_path):
    """Fails when old timesteps keep groups, or the rig's groups are removed."""
    sequence = flame_sequence(flame_model(), timesteps=(1, 2))
    head = import_head(motion_capture(sequence, tmp_path / "motion.npz"))
    bones = {group.name: [head.vertex_groups[group.name].weight(3)] for group in head.vertex_groups}
    faces = len(sequence.model.faces)
    write_selection(head, {1: np.ones(faces, bool), 2: np.ones(faces, bool)})
    write_selection(head, {2: np.arange(faces) < 4, 1: np.zeros(faces, bool)})
    names = [group.name for group in head.vertex_groups]
    assert [name for name in names if tags.group_timestep(name) is not None] == ["stga_2"]
    assert {name: [head.vertex_groups[name].weight(3)] for name in bones} == bones
    read = read_selection(head)
    assert not read[1].any()
    assert read[2].sum() == 4


def test_the_rest_of_the_head_stays(tmp_path):
    """Fails when writing weights moves vertices, turns triangles, or drops data."""
    sequence = flame_sequence(flame_model(), timesteps=(1, 2))
    head = import_head(motion_capture(sequence, tmp_path / "motion.npz"))
    mesh = head.data
    keys = mesh.shape_keys.key_blocks
    head.active_shape_key_index = len(keys) - 1
    keys[-1].value = 0.5
    own = mesh.attributes.new("own", "FLOAT", "CORNER")
    own.data.foreach_set("value", np.arange(len(mesh.loops), dtype=np.float32))
    write_selection(head, {1: np.ones(len(mesh.polygons), bool)})

    def state() -> dict[str, np.ndarray]:
        found = {key.name: read_values(key.data, "co", 3) for key in keys}
        found |= {"": read_values(mesh.vertices, "co", 3), "shown": evaluated_vertices(head)}
        found["edges"] = read_values(mesh.edges, "vertices", 2, np.int32)
        own = read_values(mesh.attributes["own"].data, "value", 1)
        return found | {"own": own, "faces": mesh_triangles(mesh)}

    before = state()
    write_selection(head, {2: np.arange(len(mesh.polygons)) < 4})
    after = state()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    assert head.active_shape_key_index == len(keys) - 1


def test_weights_of_one_half_and_more_select(capture, head):
    """Fails when painted changes are not read: added, softened and erased vertices."""
    group = head.vertex_groups.new(name=tags.group_name(3))
    group.add([10, 11, 12, 13], 1.0, "REPLACE")
    group.add([13], 0.4, "REPLACE")
    assert np.flatnonzero(read_selection(head)[3]).tolist() == [10]
    group.add([13], 0.6, "REPLACE")
    assert np.flatnonzero(read_selection(head)[3]).tolist() == [10, 11]
    group.remove([11])
    assert not read_selection(head)[3].any()


def test_group_names_of_timesteps():
    """Fails when an artist's own group counts as a selection, and is deleted with it."""
    assert tags.group_timestep("stga_12") == 12
    others = "stga_012", "stga_", "stga_-1", "stga_1_0", "stga_region_nose", "12", "jaw", "stga_٣"
    assert not [name for name in others if tags.group_timestep(name) is not None]


def test_edit_mode_and_wrong_sizes_are_refused(capture, head):
    """Fails when another error than StgaError is raised, or a selection is written in part."""
    write_selection(head, random_selection(capture))
    before = read_selection(head)
    with pytest.raises(StgaError, match=r"timestep 3 has shape \(5,\)"):
        write_selection(head, {2: np.ones(len(capture.faces), bool), 3: np.ones(5, bool)})
    bpy.context.view_layer.objects.active = head
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(StgaError, match="edit mode"):
        write_selection(head, {})
    bpy.ops.object.mode_set(mode="OBJECT")
    np.testing.assert_equal(read_selection(head), before)
