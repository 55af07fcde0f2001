"""The teeth on FLAME's real topology."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stga_addon.errors import StgaError
from stga_addon.flame.masks import key_regions
from stga_addon.flame.model import FlameModel
from stga_addon.flame.teeth import LOWER_LIP, UPPER_LIP, with_teeth

from .conftest import model_of, random_arrays

# Half the triangles of each strip, as vertex rows of 15: the added vertices stand in the order UR LR UE LE URB UEB LRB
# LEB. (row, column step) per corner; written down apart from the package's table.
UR, LR, UE, LE, URB, UEB, LRB, LEB = range(8)
RIGHT_HALF = {
    "upper front": [[(UR, 0), (UE, 1), (UE, 0)], [(UR, 0), (UR, 1), (UE, 1)]],
    "upper back": [[(URB, 0), (UEB, 0), (UEB, 1)], [(URB, 0), (UEB, 1), (URB, 1)]],
    "upper bottom": [[(UEB, 0), (UE, 0), (UEB, 1)], [(UEB, 1), (UE, 0), (UE, 1)]],
    "lower front": [[(LE, 0), (LE, 1), (LR, 0)], [(LE, 1), (LR, 1), (LR, 0)]],
    "lower back": [[(LRB, 0), (LEB, 1), (LEB, 0)], [(LRB, 0), (LRB, 1), (LEB, 1)]],
    "lower top": [[(LEB, 0), (LEB, 1), (LE, 0)], [(LEB, 1), (LE, 1), (LE, 0)]],
}


@pytest.fixture(scope="module")
def flame_open(shared_data: Path) -> FlameModel:
    """FLAME 2023 Open's template and identity; expressions, correctives and skeleton random."""
    with np.load(shared_data / "flame_open" / "flame2023_open_basis.npz") as data:
        arrays = random_arrays(vertices=5023, components=80)
        arrays["shapedirs"][:, :, :60] = data["shapedirs"]
        arrays |= {"v_template": data["v_template"].astype(float), "f": data["faces"]}
    return model_of(arrays, n_identity=60)


@pytest.fixture(scope="module")
def toothed(flame_open: FlameModel) -> FlameModel:
    return with_teeth(flame_open)


def _strip_normals(model: FlameModel) -> dict[str, np.ndarray]:
    corners = model.v_template[model.faces[9976:]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return dict(zip(RIGHT_HALF, normals.reshape(6, 28, 3), strict=True))


def test_counts_and_untouched_head(flame_open: FlameModel, toothed: FlameModel) -> None:
    # Catches vertices that are inserted rather than appended: tracked offsets would land elsewhere.
    assert (len(toothed.v_template), len(toothed.faces)) == (5143, 10144)
    for name in ("v_template", "shapedirs", "posedirs", "weights"):
        np.testing.assert_array_equal(getattr(toothed, name)[:5023], getattr(flame_open, name))
    np.testing.assert_array_equal(toothed.faces[:9976], flame_open.faces)
    assert toothed.faces[9976:].min() == 5023
    assert set(toothed.faces[9976:].ravel()) == set(range(5023, 5143))


def test_triangle_table(toothed: FlameModel) -> None:
    # Catches a wrong corner order. The right half is a second transcription; the left half must be its mirror image
    # (rows kept, columns reversed), which is what makes teeth symmetric and was not used to write the table.
    added = toothed.faces[9976:] - 5023
    for strip, faces in zip(RIGHT_HALF.values(), added.reshape(6, 14, 2, 3), strict=True):
        for column in range(7):
            expected = [[row * 15 + column + step for row, step in corner] for corner in strip]
            assert faces[column].tolist() == expected
            mirrored = [frozenset(row * 15 + 14 - column - step for row, step in corner) for corner in strip]
            assert {frozenset(face) for face in faces[13 - column].tolist()} == set(mirrored)


def test_each_row_is_an_open_strip(toothed: FlameModel) -> None:
    # Catches doubled or flipped triangles: within a row of teeth every inner edge is run through once each way.
    for half in (toothed.faces[9976 : 9976 + 84], toothed.faces[9976 + 84 :]):
        edges = [tuple(edge) for face in half.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)]
        assert len(set(edges)) == len(edges)
        boundary = [edge for edge in edges if edge[::-1] not in set(edges)]
        # Root of front and back open (14 each), three strips' open ends at both sides (3 each).
        assert len(boundary) == 2 * 14 + 2 * 3


def test_sides_face_outwards(toothed: FlameModel) -> None:
    # Catches teeth that are lit or culled from the wrong side.
    normals = _strip_normals(toothed)
    assert (normals["upper front"][:, 2] > 0.2).all()
    assert (normals["lower front"][:, 2] > 0.2).all()
    assert (normals["upper back"][:, 2] < -0.2).all()
    assert (normals["lower back"][:, 2] < -0.2).all()
    assert (normals["upper bottom"][:, 1] < -0.9).all()
    assert (normals["lower top"][:, 1] > 0.9).all()


def test_where_the_teeth_stand(toothed: FlameModel) -> None:
    # Catches a wrong scale or side: behind the lips, inside the mouth's width, upper above lower, in meters.
    rows = toothed.v_template[5023:].reshape(8, 15, 3)
    upper, lower = toothed.v_template[list(UPPER_LIP)], toothed.v_template[list(LOWER_LIP)]
    gap = np.linalg.norm(upper - lower, axis=1).mean()
    np.testing.assert_allclose(rows[UE, :, 1] - rows[LE, :, 1], 0.2 * gap, atol=1e-12)
    np.testing.assert_allclose(rows[UE, :, 2] - rows[LE, :, 2], 0.4 * gap, atol=1e-12)
    np.testing.assert_allclose(rows[[UR, LR]] - rows[[UE, LE]], [[[0, 2 * gap, 0]] * 15, [[0, -2 * gap, 0]] * 15])
    np.testing.assert_allclose(rows[[UR, UE, LR, LE]] - rows[[URB, UEB, LRB, LEB]], [[[0, 0, gap]] * 15] * 4)
    np.testing.assert_allclose(rows[UE, :, [0, 2]], ((upper + lower) / 2)[:, [0, 2]].T - [[0], [1.5 * gap]])
    assert (np.diff(rows[UE, :, 0]) < 0).all()
    assert np.ptp(rows[UE, :, 1]) < 1e-12


def test_what_moves_the_teeth(flame_open: FlameModel, toothed: FlameModel) -> None:
    # Catches teeth that follow expressions, the wrong bone, or shift the joints.
    rows = np.repeat(np.arange(8), 15)
    jaw = np.isin(rows, (LR, LE, LRB, LEB))
    np.testing.assert_array_equal(toothed.weights[5023:][jaw], np.tile([0, 0, 1, 0, 0], (60, 1)))
    np.testing.assert_array_equal(toothed.weights[5023:][~jaw], np.tile([0, 1, 0, 0, 0], (60, 1)))
    assert not toothed.shapedirs[5023:, :, 60:].any()
    assert not toothed.posedirs[5023:].any()
    assert not toothed.j_regressor[:, 5023:].any()
    np.testing.assert_array_equal(toothed.j_regressor[:, :5023], flame_open.j_regressor)
    column = 4
    lips = (flame_open.shapedirs[UPPER_LIP[column]] + flame_open.shapedirs[LOWER_LIP[column]])[:, :60] / 2
    for row in range(8):
        np.testing.assert_array_equal(toothed.shapedirs[5023 + row * 15 + column, :, :60], lips)


def test_teeth_belong_to_the_mouth(flame_open: FlameModel) -> None:
    # Catches selection that leaves the teeth out of the mouth region.
    model = with_teeth(replace(flame_open, masks={"lips": np.array([*UPPER_LIP, *LOWER_LIP])}))
    assert key_regions(model)["mouth"][9976:].all()


def test_other_topologies_are_refused(tiny_flame: FlameModel) -> None:
    with pytest.raises(StgaError, match="40 vertices, expected FLAME's topology of 5023"):
        with_teeth(tiny_flame)
