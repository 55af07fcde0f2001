"""The teeth on FLAME's real topology."""

import zlib
from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.flame.parts import key_regions
from stga_addon.flame.teeth import lip_pairs, teeth_faces, with_teeth

from .mouths import covered_from_front, crossings, jaw_opened, open_edges, open_flame

# The added vertices stand in this order, in rows of 15.
UR, LR, UE, LE, URB, UEB, LRB, LEB = range(8)
LAYOUT_CRC32 = 0xB43FE122


@pytest.fixture(scope="module")
def flame_open(shared_data):
    return open_flame(shared_data)


@pytest.fixture(scope="module")
def toothed(flame_open):
    return with_teeth(flame_open)


def test_counts_and_untouched_head(flame_open, toothed):
    """Catches vertices inserted, teeth out of the mouth or on other bones, and slivers."""
    assert (len(toothed.v_template), len(toothed.faces)) == (5143, 10144)
    model = with_teeth(replace(flame_open, masks={"lips": np.concatenate(lip_pairs(flame_open))}))
    assert key_regions(model)["mouth"][9976:].all()
    for name in ("v_template", "shapedirs", "posedirs", "weights"):
        assert_array_equal(getattr(toothed, name)[:5023], getattr(flame_open, name))
    assert_array_equal(toothed.faces[:9976], flame_open.faces)
    assert toothed.faces[9976:].min() == 5023
    jaw = np.isin(np.repeat(np.arange(8), 15), (LR, LE, LRB, LEB))
    assert_array_equal(toothed.weights[5023:][jaw], np.tile([0, 0, 1, 0, 0], (60, 1)))
    assert_array_equal(toothed.weights[5023:][~jaw], np.tile([0, 1, 0, 0, 0], (60, 1)))
    assert not toothed.shapedirs[5023:, :, 60:].any()
    assert not toothed.posedirs[5023:].any()
    assert not toothed.j_regressor[:, 5023:].any()
    assert_array_equal(toothed.j_regressor[:, :5023], flame_open.j_regressor)
    corners = toothed.v_template[toothed.faces[9976:]]
    edges = corners[:, 1:] - corners[:, :1]
    double_area = norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    longest = norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    assert double_area.min() / 2 > 1.5e-6
    assert (double_area / longest**2).min() > 0.15


def test_index_layout():
    """Catches triangles in another order, doubled, flipped, or that start at another corner: splats
    bound to them by index would turn or move to another tooth."""
    assert zlib.crc32(teeth_faces(0).astype("<i4").tobytes()) == LAYOUT_CRC32


def test_rows_bite(toothed):
    """Catches rows that are upside down, far apart or larger than teeth, and an arch that is
    shifted, or turned towards one cheek."""
    rows = toothed.v_template[5023:].reshape(8, 15, 3)
    assert_allclose(rows[:, ::-1, 1:], rows[:, :, 1:], atol=1e-12)
    plane = (rows[:, ::-1, 0] + rows[:, :, 0]) / 2
    assert_allclose(plane, plane[0, 0], atol=1e-12)
    assert abs(plane[0, 0]) < 0.0003
    assert (np.diff(rows[:, :, 0]) < 0).all()
    assert 0.001 < (rows[LE, :, 1] - rows[UE, :, 1]).mean() < 0.004
    assert 0.002 < rows[UE, 7, 2] - rows[LE, 7, 2] < 0.005
    for root, edge in ((UR, UE), (LR, LE)):
        assert 0.008 < np.abs(rows[root, 7, 1] - rows[edge, 7, 1]) < 0.016
    assert 0.03 < np.ptp(rows[UE, :, 0]) < 0.05


@pytest.mark.parametrize("jaw_deg", [0, 10, 20])
def test_teeth_stay_behind_the_lips(toothed, jaw_deg):
    """Catches teeth in the flesh, or through the lips, of the mean face and of others."""
    skin = toothed.faces[:9976]
    teeth = toothed.faces[9976:]
    for seed in range(5):
        shape = np.random.default_rng(seed).normal(size=60) * (seed > 0)
        mesh = jaw_opened(toothed, jaw_deg, shape)
        assert crossings(mesh, skin, teeth) == 0
        assert crossings(mesh, teeth[:84], teeth[84:]) == 0
        if jaw_deg == 0:
            assert covered_from_front(mesh, skin, mesh[teeth].mean(1)).all()
    mesh[5023:, 2] += 0.005
    assert crossings(mesh, skin, teeth) > 10  # what is counted above can be found


def test_identity_carries_the_teeth(flame_open):
    """Catches teeth that stay, or grow otherwise, where the head is moved, wider, longer or has a
    bent mouth."""
    template = flame_open.v_template
    shapes = np.zeros((len(template), 3, 4))
    shapes[:, :, 0] = [0.001, 0.002, 0.003]
    shapes[:, 0, 1] = template[:, 0]
    shapes[:, 1, 2] = template[:, 1]
    shapes[:, 2, 3] = template[:, 0] ** 2
    teeth = with_teeth(replace(flame_open, shapedirs=shapes, n_identity=4))
    at = teeth.v_template[5023:]
    found = teeth.shapedirs[5023:]
    expected = np.zeros_like(found)
    expected[:, :, 0] = [0.001, 0.002, 0.003]
    expected[:, 0, 1] = at[:, 0]
    expected[:, 1, 2] = at[:, 1]
    expected[:, 2, 3] = at[:, 0] ** 2
    assert_allclose(found, expected, atol=1e-9)


def test_teeth_and_lips_come_from_the_mesh(flame_open, toothed):
    """Catches lists of one mesh's vertices, lengths in meters, and lips paired wrongly."""
    order = np.random.default_rng(1).permutation(5023)
    number = np.argsort(order)
    faces = number[flame_open.faces].astype(np.int32)
    shapes = flame_open.shapedirs[order]
    template = 2 * flame_open.v_template[order]
    other = with_teeth(replace(flame_open, v_template=template, shapedirs=shapes, faces=faces))
    assert_allclose(other.v_template[5023:], 2 * toothed.v_template[5023:], atol=1e-9)
    assert_allclose(other.shapedirs[5023:], toothed.shapedirs[5023:], atol=1e-9)
    assert_array_equal(order[np.array(lip_pairs(other))], lip_pairs(toothed))
    upper, lower = (flame_open.v_template[ids] for ids in lip_pairs(toothed))
    assert_array_equal(lip_pairs(toothed), lip_pairs(flame_open))
    assert (np.diff(upper[:, 0]) < 0).all()
    assert (np.diff(lower[:, 0]) < 0).all()
    assert (upper[:, 1] > lower[:, 1]).all()
    assert np.abs(upper[:, 0] - lower[:, 0]).max() < 0.003
    assert np.ptp(upper[:, 0]) > 0.045
    opened = jaw_opened(toothed, 20)
    upper, lower = lip_pairs(toothed)
    meshes = flame_open.v_template, opened
    before, after = (norm(at[upper] - at[lower], axis=1).max() for at in meshes)
    assert after - before > 0.008


def test_a_closed_mouth_is_refused(flame_open):
    """Catches teeth at the neck, which is open too."""
    in_front = np.flatnonzero(flame_open.v_template[:, 2] > 0.03)
    edges = [(a, b) for a, b in open_edges(flame_open.faces) if a in in_front and b in in_front]
    lid = [(b, a, edges[0][0]) for a, b in edges if edges[0][0] not in (a, b)]
    faces = np.concatenate([flame_open.faces, np.array(lid, np.int32)])
    with refusal("closed mouth"):
        with_teeth(replace(flame_open, faces=faces))
