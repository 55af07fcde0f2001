"""Colors that continue over a surface: against the equation's solution on a plane."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.training.optimize.color_fill import filled_colors

SIDE = 24


@pytest.fixture(scope="module")
def plane():
    """Equilateral triangles of a parallelogram, and their centers: neighbors are equally far."""
    column, row = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    mesh = np.stack([column + row / 2, row * 0.75**0.5, 0 * row], axis=-1) / SIDE
    corner = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a = corner[:-1, :-1]
    b = corner[:-1, 1:]
    c = corner[1:, :-1]
    d = corner[1:, 1:]
    faces = np.concatenate([np.stack(rows, -1).reshape(-1, 3) for rows in ((a, b, c), (b, d, c))])
    return faces, mesh.reshape(-1, 3)[faces].mean(1)


def filled(plane, color, known, group=None, detail=None):
    faces, _ = plane
    count = len(faces)
    group = np.zeros(count, int) if group is None else group
    detail = np.full((count, 3), np.nan) if detail is None else detail
    return filled_colors(faces, color, 1e6 * known, group, detail)


def harmonic(centers):
    """(F, 3) colors whose second derivatives cancel, so that the fill must find them."""
    x, y, _ = centers.T
    return np.stack([x, x * x - y * y, x * y], axis=1)


def test_a_harmonic_color_is_continued(plane):
    """Catches couplings of triangles that have no common edge, and a wrong border."""
    _, centers = plane
    known = np.abs(centers - centers.mean(0)).max(1) > 0.3
    color = np.where(known[:, None], harmonic(centers), 9.0)
    found = filled(plane, color, known)
    assert_allclose(found, harmonic(centers), atol=0.002)


def test_a_mirrored_detail_is_kept(plane):
    """Catches a detail that is copied with its light instead of its differences."""
    _, centers = plane
    known = centers[:, 0] < 0.2
    detail = 0.2 * np.sin(20 * centers) + 0.5
    color = np.where(known[:, None], detail - 0.3, 9.0)
    found = filled(plane, color, known, detail=detail)
    assert_allclose(found, detail - 0.3, atol=1e-3)


def test_groups_are_no_neighbors(plane):
    """Catches hair that bleeds into skin, and a part without an observed color that gets one."""
    _, centers = plane
    group = np.digitize(centers[:, 0], [0.3, 0.6])
    known = (centers[:, 1] < 0.2) & (group < 2)
    color = np.where(group[:, None] == 0, 0.2, 0.8) * np.ones(3)
    found = filled(plane, color, known, group=group)
    assert_allclose(found[group < 2], color[group < 2], atol=1e-6)
    assert np.isnan(found[group == 2]).all()
