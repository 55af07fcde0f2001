"""Selections: written as vertex groups and read back, chosen as a whole, counted, and seen."""

import bpy
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from refusal import refusal

from stga_addon.capture.open import open_capture
from stga_addon.capture.selection import SelectionOptions, select_capture
from stga_addon.scene import tags
from stga_addon.scene.arrays import evaluated_vertices, mesh_triangles, read_values
from stga_addon.scene.display.splat_attributes import read_attribute
from stga_addon.scene.rig.head import import_head
from stga_addon.scene.vertex_groups import FRACTION, HEAT, read_selection, write_selection

from .captures import closure, flame_model, flame_sequence, mesh_capture, motion_capture
from .session import failure, ops, panel
from .test_operators import show_ball

pytestmark = pytest.mark.usefixtures("extension")


def rows():
    return [(row.frame, row.triangles, row.splats) for row in panel().selected_frames]


def paint_chin(head, capture):
    """A vertex group of triangles half of which never move: (F,) bool."""
    centres = capture.neutral[capture.faces].mean(1)
    low = np.unique(capture.faces[centres[:, 1] < -0.02])
    head.vertex_groups.new(name="chin").add(low.tolist(), 1.0, "REPLACE")
    region = np.isin(capture.faces, low).all(1)
    moved = (capture.mesh(3) - capture.neutral)[capture.faces].mean(1)
    offset = np.linalg.norm(moved[region], axis=1)
    assert offset.min() < 0.0005 < offset.mean()
    return region


def test_regions_that_are_selected_as_a_whole(head, tmp_path):
    """Catches a painted region ignored or taken in part, and unknown ones."""
    capture = open_capture(tmp_path / "capture")
    region = paint_chin(head, capture)
    alone = select_capture(capture, SelectionOptions(threshold=0.0005))[3]
    for expected in (alone | region, alone):
        ops.toggle_region(name="chin")
        ops.select(threshold=0.0005)
        assert_array_equal(read_selection(head)[3], closure(expected, capture.faces))
    ops.select(threshold=0.0005, regions="chin")
    before = {timestep: faces.tolist() for timestep, faces in read_selection(head).items()}
    assert np.array(before[3])[region].all()
    assert not any(before[0])
    assert head["stga_key_regions"] == "chin"
    head.vertex_groups.new(name="empty")
    for operator, arguments, sentence in (
        ("toggle_region", {"name": "nostril"}, "no region and no vertex group 'nostril'"),
        ("select", {"regions": "mouth, lips"}, "no region and no vertex group 'lips'"),
        ("select", {"regions": "empty"}, "no triangle has all its corners in .* 'empty'"),
    ):
        with failure(sentence):
            getattr(ops, operator)(**arguments)
    assert {t: faces.tolist() for t, faces in read_selection(head).items()} == before


def test_the_table_counts_what_each_frame_trains(head, tmp_path):
    """Catches counts of the rule instead of the groups, of six a triangle, or of another head."""
    ops.select(threshold=0.0005)
    chosen = read_selection(head)
    assert rows() == [(t, int(faces.sum()), 6 * int(faces.sum())) for t, faces in chosen.items()]
    avatar = show_ball(tmp_path / "a.npz", order=4)
    per_face = np.bincount(avatar.splats.face, minlength=len(avatar.faces))
    head.vertex_groups["stga_3"].add(list(range(80)), 0.4, "REPLACE")
    head.vertex_groups["stga_3"].add(list(range(80, 120)), 0.6, "REPLACE")
    ops.count_selected()
    painted = read_selection(head)
    corners = np.array([polygon.vertices[:] for polygon in head.data.polygons])
    inside = np.zeros(len(head.data.vertices), bool)
    inside[np.unique(corners[chosen[3]])] = True
    inside[80:120] = True
    inside[:80] = False
    assert_array_equal(painted[3], inside[corners].all(1))
    assert painted[3].sum() != chosen[3].sum()
    assert rows() == [
        (t, int(faces.sum()), int(per_face[faces].sum())) for t, faces in painted.items()
    ]
    panel().head = None
    assert rows() == []


def materials_of(head):
    """The materials that the head's triangles are drawn with."""
    mesh = head.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    return {mesh.materials[polygon.material_index].name for polygon in mesh.polygons}


def test_heat_map(head, tmp_path):
    """Catches colors of other triangles or an old selection, and a head left changed."""
    with failure("no frame selects a triangle yet"):
        ops.heat_map()
    head.data.materials.append(bpy.data.materials.new("skin"))
    ops.select(threshold=0.0025)
    ops.heat_map()
    ops.select(threshold=0.0015)
    expected = np.mean(list(read_selection(head).values()), axis=0)
    assert_allclose(read_attribute(head.data, FRACTION), expected, atol=1e-6)
    assert head.data.color_attributes.active_color.name == HEAT
    color = read_attribute(head.data, HEAT).reshape(-1, 3, 4)
    assert (color == color[:, :1]).all(), "a triangle's corners differ"
    hottest = color[expected.argmax(), 0]
    never = color[expected.argmin(), 0]
    assert hottest[0] > 0.8 > 0.2 > never[0]
    assert materials_of(head) == {"STGA Heat Map"}
    ops.heat_map(show=False)
    assert not head.modifiers
    assert not {FRACTION, HEAT} & set(head.data.attributes.keys())
    assert materials_of(head) == {"skin"}
    show_ball(tmp_path / "a.npz", order=2)
    for show in (True, False):
        ops.heat_map(show=show)
        assert head.visible_get() == show
        assert panel().splats.hide_get() == show


def test_only_selection_groups_change(tmp_path):
    """Fails when old timesteps or other groups go or stay wrongly, or vertices, faces or data
    change."""
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
    assert tags.group_timestep("stga_12") == 12
    others = "stga_012", "stga_", "stga_-1", "stga_1_0", "stga_region_nose", "12", "jaw", "stga_٣"
    assert not [name for name in others if tags.group_timestep(name) is not None]
    mesh = head.data
    keys = mesh.shape_keys.key_blocks
    head.active_shape_key_index = len(keys) - 1
    keys[-1].value = 0.5
    own = mesh.attributes.new("own", "FLOAT", "CORNER")
    own.data.foreach_set("value", np.arange(len(mesh.loops), dtype=np.float32))
    write_selection(head, {1: np.ones(len(mesh.polygons), bool)})

    def state():
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


def test_edit_mode_and_wrong_sizes_are_refused(tmp_path):
    """Fails when a group has another frame or vertices, or a selection is written in part."""
    capture = mesh_capture(tmp_path, timesteps=(2, 3, 7))
    head = import_head(capture)
    chosen = np.random.default_rng(0).random((3, len(capture.faces))) < 0.2
    write_selection(head, dict(zip(capture.timesteps, chosen, strict=True)))
    before = read_selection(head)
    for selected, found in zip(chosen, before.values(), strict=True):
        assert_array_equal(found, closure(selected, capture.faces))
    write_selection(head, before)
    with refusal(r"timestep 3 has shape \(5,\)"):
        write_selection(head, {2: np.ones(len(capture.faces), bool), 3: np.ones(5, bool)})
    bpy.context.view_layer.objects.active = head
    bpy.ops.object.mode_set(mode="EDIT")
    with refusal("edit mode"):
        write_selection(head, {})
    bpy.ops.object.mode_set(mode="OBJECT")
    assert_equal(read_selection(head), before)
