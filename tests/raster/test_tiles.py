"""Order of the splats by depth against numpy's stable sort, and the order in which tiles are rendered."""

import numpy as np
import pytest

pytest.importorskip("numba")

from stga_addon.raster.cpu.blend import RUN_TILES
from stga_addon.raster.cpu.layout import TileLists
from stga_addon.raster.cpu.rasterize import heaviest_first
from stga_addon.raster.cpu.tiles import SPLATS_PER_SORT, depth_order, list_visible


@pytest.mark.parametrize("most", [1.0, 1.0 + 1e-6, 1.1, 3.0, 1e9, 3e38])
@pytest.mark.parametrize("least", [1.0, 0.01])
def test_depths_are_sorted_whatever_their_range(least, most):
    """Catches a pass left out where depths differ in high bits only, equal depths that change places, and parts that
    overlap or lose splats where they meet."""
    rng = np.random.default_rng(0)
    depth = np.geomspace(least, most, 3000).astype(np.float32)[rng.integers(0, 3000, 60_000)]
    candidates = np.flatnonzero(rng.random(60_000) < 0.7).astype(np.int32)
    expected = candidates[np.argsort(depth[candidates], kind="stable")]
    assert len(expected) > 2 * SPLATS_PER_SORT
    np.testing.assert_array_equal(depth_order(depth, candidates), expected)


def test_splats_with_tiles_are_listed():
    """Catches splats left out at the end, and broken ones (−1) that are listed."""
    rect = np.array([[0, 0, 0, 0], [1, 2, 3, 4], [-1, -1, -1, -1], [0, 0, 1, 1], [5, 0, 6, 2]], np.int32)
    np.testing.assert_array_equal(list_visible(rect), [1, 3, 4])
    assert len(list_visible(rect[:1])) == 0
    assert len(depth_order(np.ones(0, np.float32), np.zeros(0, np.int32))) == 0


@pytest.mark.parametrize("count", [1, 7, 8, 1785])
def test_runs_of_tiles_begin_with_the_fullest(count):
    """Catches tiles that are lost or doubled, neighbors that are torn apart, and a long run that is left to the end,
    where all threads but one wait for it."""
    rng = np.random.default_rng(1)
    pairs = rng.integers(0, 400, 1785)
    lists = TileLists(*[np.zeros(0, np.int32)] * 4, np.append(0, np.cumsum(pairs)), np.zeros(0, np.int32))
    given = np.sort(rng.choice(1785, count, replace=False)).astype(np.int32)
    tiles = heaviest_first(given, lists)
    np.testing.assert_array_equal(np.sort(tiles), given)
    whole = count // RUN_TILES * RUN_TILES
    runs = tiles[:whole].reshape(-1, RUN_TILES)
    assert {tuple(run) for run in runs.tolist()} == {tuple(r) for r in given[:whole].reshape(-1, RUN_TILES).tolist()}
    assert (np.diff(pairs[runs].sum(1)) <= 0).all()
