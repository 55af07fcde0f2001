"""Choosing what is selected as a whole, counting it, and seeing it."""

import bpy
import numpy as np
import pytest

from stga_addon.capture.open import open_capture
from stga_addon.scene.vertex_groups import HEAT, SHARE, read_selection
from stga_addon.selection import SelectionOptions, select_capture

from .captures import closure
from .test_operators import write_ball_avatar

pytestmark = pytest.mark.usefixtures("extension")


def rows() -> list[tuple[int, int, int]]:
    return [
        (row.frame, row.triangles, row.splats) for row in bpy.context.scene.stga.selected_frames
    ]


def paint_chin(head, capture) -> np.ndarray:
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
    """Catches a painted region that is ignored or taken triangle by triangle, a tick in the panel
    that the selection does not hear of, and a misspelt or unpainted region that silently selects
    nothing."""
    capture = open_capture(tmp_path / "capture")
    region = paint_chin(head, capture)
    alone = select_capture(capture, SelectionOptions(threshold=0.0005))[3]
    for expected in (alone | region, alone):
        bpy.ops.stga.toggle_region(name="chin")
        bpy.ops.stga.select(threshold=0.0005)
        np.testing.assert_array_equal(read_selection(head)[3], closure(expected, capture.faces))
    bpy.ops.stga.select(threshold=0.0005, regions="chin")
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
        with pytest.raises(RuntimeError, match=sentence):
            getattr(bpy.ops.stga, operator)(**arguments)
    assert {t: faces.tolist() for t, faces in read_selection(head).items()} == before


def test_the_table_counts_what_each_frame_trains(head, tmp_path):
    """Catches counts of the rule instead of the groups, of six splats a triangle always, or of
    another head."""
    bpy.ops.stga.select(threshold=0.0005)
    chosen = read_selection(head)
    assert rows() == [(t, int(faces.sum()), 6 * int(faces.sum())) for t, faces in chosen.items()]
    avatar = write_ball_avatar(tmp_path / "a.npz", order=4)
    bpy.ops.stga.show_avatar(filepath=str(tmp_path / "a.npz"))
    per_face = np.bincount(avatar.splats.face, minlength=len(avatar.faces))
    head.vertex_groups["stga_3"].remove(list(range(80)))
    bpy.ops.stga.count_selected()
    painted = read_selection(head)
    assert painted[3].sum() < chosen[3].sum()
    assert rows() == [
        (t, int(faces.sum()), int(per_face[faces].sum())) for t, faces in painted.items()
    ]
    bpy.context.scene.stga.head = None
    assert rows() == []


def materials_of(head) -> set[str]:
    """The materials that the head's triangles are drawn with."""
    mesh = head.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    return {mesh.materials[polygon.material_index].name for polygon in mesh.polygons}


def heat(head, name: str, kind: str, size: int) -> np.ndarray:
    attribute = head.data.attributes[name].data
    values = np.empty(len(attribute) * size, np.float32)
    attribute.foreach_get(kind, values)
    return values


def test_heat_map(head, tmp_path):
    """Catches colors on the wrong triangles or of yesterday's selection, a heat map that the splats
    cover, and a head that does not look as before once they are gone."""
    with pytest.raises(RuntimeError, match="no frame selects a triangle yet"):
        bpy.ops.stga.heat_map()
    head.data.materials.append(bpy.data.materials.new("skin"))
    bpy.ops.stga.select(threshold=0.0025)
    bpy.ops.stga.heat_map()
    bpy.ops.stga.select(threshold=0.0015)
    expected = np.mean(list(read_selection(head).values()), axis=0)
    np.testing.assert_allclose(heat(head, SHARE, "value", 1), expected, atol=1e-6)
    assert head.data.color_attributes.active_color.name == HEAT
    color = heat(head, HEAT, "color", 4).reshape(-1, 3, 4)
    assert (color == color[:, :1]).all(), "a triangle's corners differ"
    hottest, never = color[expected.argmax(), 0], color[expected.argmin(), 0]
    assert hottest[0] > 0.8 > 0.2 > never[0]
    assert materials_of(head) == {"STGA Heat Map"}
    bpy.ops.stga.heat_map(show=False)
    assert not head.modifiers
    assert not {SHARE, HEAT} & set(head.data.attributes.keys())
    assert materials_of(head) == {"skin"}
    write_ball_avatar(tmp_path / "a.npz", order=2)
    bpy.ops.stga.show_avatar(filepath=str(tmp_path / "a.npz"))
    for show in (True, False):
        bpy.ops.stga.heat_map(show=show)
        assert head.hide_get() != show
        assert bpy.context.scene.stga.splats.hide_get() == show
