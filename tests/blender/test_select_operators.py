"""Choosing what is selected as a whole, counting it, and seeing it."""

from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from capture.factory import ball, write_mesh_capture  # noqa: E402

from stga_addon.avatar.file import Avatar, write_avatar  # noqa: E402
from stga_addon.avatar.lattice import lattice_splats  # noqa: E402
from stga_addon.capture.open import open_capture  # noqa: E402
from stga_addon.scene.vertex_groups import (  # noqa: E402
    HEAT,
    SHARE,
    read_selection,
)
from stga_addon.selection import SelectionOptions, select_capture  # noqa: E402

from .captures import closure  # noqa: E402

pytestmark = pytest.mark.usefixtures("extension")


@pytest.fixture
def folder(tmp_path) -> Path:
    folder = write_mesh_capture(tmp_path / "capture")
    bpy.ops.stga.import_capture(directory=str(folder))
    return folder


def the_head():
    return bpy.context.scene.stga.head


def rows() -> list[tuple[int, int, int]]:
    return [
        (row.frame, row.triangles, row.splats) for row in bpy.context.scene.stga.selected_frames
    ]


def show_ball_avatar(path: Path, order: int) -> np.ndarray:
    """Splats on each triangle of the avatar that is shown."""
    vertices, faces = ball()
    splats = lattice_splats(vertices, faces.astype(np.int32), order=order)
    write_avatar(path, Avatar(splats, "stga", vertices.astype(np.float32), faces.astype(np.int32)))
    bpy.ops.stga.show_avatar(filepath=str(path))
    return np.bincount(splats.face, minlength=len(faces))


def paint_chin(capture) -> np.ndarray:
    """A vertex group of triangles half of which never move: (F,) bool."""
    centres = capture.neutral[capture.faces].mean(1)
    low = np.unique(capture.faces[centres[:, 1] < -0.02])
    the_head().vertex_groups.new(name="chin").add(low.tolist(), 1.0, "REPLACE")
    region = np.isin(capture.faces, low).all(1)
    offset = np.linalg.norm((capture.mesh(3) - capture.neutral)[capture.faces].mean(1), axis=1)[
        region
    ]
    assert offset.min() < 0.0005 < offset.mean()
    return region


def test_a_painted_group_is_a_key_region(folder):
    """Catches a painted region that is ignored, or taken triangle by triangle."""
    region = paint_chin(open_capture(folder))
    assert bpy.ops.stga.select(threshold=0.0005, regions="chin") == {"FINISHED"}
    written = read_selection(the_head())
    assert written[3][region].all()
    assert not written[0].any()
    assert the_head()["stga_key_regions"] == "chin"


def test_ticking_regions(folder):
    """Catches a tick in the panel that the selection does not hear of."""
    capture = open_capture(folder)
    region = paint_chin(capture)
    alone = select_capture(capture, SelectionOptions(threshold=0.0005))[3]
    for expected in (alone | region, alone):
        bpy.ops.stga.toggle_region(name="chin")
        bpy.ops.stga.select(threshold=0.0005)
        np.testing.assert_array_equal(
            read_selection(the_head())[3], closure(expected, capture.faces)
        )
    with pytest.raises(RuntimeError, match="no region and no vertex group 'nostril'"):
        bpy.ops.stga.toggle_region(name="nostril")


def test_regions_that_are_not_there(folder):
    """Catches a misspelt or unpainted region that silently selects nothing."""
    bpy.ops.stga.select(threshold=0.0005)
    before = {timestep: faces.tolist() for timestep, faces in read_selection(the_head()).items()}
    with pytest.raises(RuntimeError, match="no region and no vertex group 'lips'"):
        bpy.ops.stga.select(regions="mouth, lips")
    the_head().vertex_groups.new(name="empty")
    with pytest.raises(
        RuntimeError, match="no triangle has all its corners in the vertex group 'empty'"
    ):
        bpy.ops.stga.select(regions="empty")
    assert {
        timestep: faces.tolist() for timestep, faces in read_selection(the_head()).items()
    } == before


def test_the_table_counts_what_each_frame_trains(folder, tmp_path):
    """Catches counts of the rule instead of the groups, of six splats a triangle always, or of
    another head."""
    bpy.ops.stga.select(threshold=0.0005)
    chosen = read_selection(the_head())
    assert rows() == [(t, int(faces.sum()), 6 * int(faces.sum())) for t, faces in chosen.items()]
    per_face = show_ball_avatar(tmp_path / "a.npz", order=4)
    the_head().vertex_groups["stga_3"].remove(list(range(80)))
    bpy.ops.stga.count_selected()
    painted = read_selection(the_head())
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


def test_heat_map(folder):
    """Catches colors on the wrong triangles, and a head that does not look as before once they are
    gone."""
    with pytest.raises(RuntimeError, match="no frame selects a triangle yet"):
        bpy.ops.stga.heat_map()
    bpy.ops.stga.select(threshold=0.0015)
    head = the_head()
    head.data.materials.append(bpy.data.materials.new("skin"))
    expected = np.mean(list(read_selection(head).values()), axis=0)
    assert bpy.ops.stga.heat_map() == {"FINISHED"}
    share = np.empty(len(expected), np.float32)
    head.data.attributes[SHARE].data.foreach_get("value", share)
    np.testing.assert_allclose(share, expected, atol=1e-6)
    assert head.data.color_attributes.active_color.name == HEAT
    color = np.empty(12 * len(expected), np.float32)
    head.data.attributes[HEAT].data.foreach_get("color", color)
    color = color.reshape(-1, 3, 4)
    assert (color == color[:, :1]).all(), "a triangle's corners differ"
    hottest, never = color[expected.argmax(), 0], color[expected.argmin(), 0]
    assert hottest[0] > 0.8 > 0.2 > never[0]
    assert materials_of(head) == {"STGA Heat Map"}
    assert bpy.ops.stga.heat_map(show=False) == {"FINISHED"}
    assert not head.modifiers
    assert not {SHARE, HEAT} & set(head.data.attributes.keys())
    assert materials_of(head) == {"skin"}


def test_heat_map_follows_a_new_selection(folder):
    """Catches yesterday's heat map under today's selection."""
    bpy.ops.stga.select(threshold=0.0025)
    bpy.ops.stga.heat_map()
    bpy.ops.stga.select(threshold=0.0005)
    share = np.empty(len(the_head().data.polygons), np.float32)
    the_head().data.attributes[SHARE].data.foreach_get("value", share)
    np.testing.assert_allclose(
        share, np.mean(list(read_selection(the_head()).values()), axis=0), atol=1e-6
    )


def test_heat_map_and_splats_take_turns(folder, tmp_path):
    """Catches a heat map that the splats cover."""
    bpy.ops.stga.select(threshold=0.0005)
    show_ball_avatar(tmp_path / "a.npz", order=2)
    head, splats = the_head(), bpy.context.scene.stga.splats
    bpy.ops.stga.heat_map()
    assert not head.hide_get()
    assert splats.hide_get()
    bpy.ops.stga.heat_map(show=False)
    assert head.hide_get()
    assert not splats.hide_get()
