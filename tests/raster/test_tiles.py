"""Order of the splats by depth against numpy's stable sort, and the order in which tiles are rendered."""

import numpy as np
import pytest

pytest.importorskip("numba")

from stga_addon.raster.cpu.layout import TileLists
from stga_addon.raster.cpu.rasterize import balance_tiles
from stga_addon.raster.cpu.threads import cut, set_threads, threads
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


@pytest.mark.parametrize("count", [1, 2, 16])
def test_pieces_of_tiles_have_equally_many_pairs(count):
    """Catches tiles that are lost or doubled, and a thread that gets the full tiles of the middle."""
    before = threads()
    set_threads(count)
    try:
        rng = np.random.default_rng(1)
        far = np.abs(np.arange(1785) % 51 - 25) + np.abs(np.arange(1785) // 51 - 17)
        pairs = np.where(far < 20, rng.integers(200, 400, 1785), 0)
        lists = TileLists(*[np.zeros(0, np.int32)] * 4, np.append(0, np.cumsum(pairs)), np.zeros(0, np.int32))
        tiles = balance_tiles(np.arange(1785, dtype=np.int32), lists)
        np.testing.assert_array_equal(np.sort(tiles), np.arange(1785))
        pieces = [pairs[tiles[a:b]].sum() for a, b in cut(1785)]
        assert max(pieces) < 1.5 * sum(pieces) / len(pieces)
    finally:
        set_threads(before)
