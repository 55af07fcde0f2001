"""The tiles' lists against numpy's stable sort, and the order in which tiles are rendered."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from stga_addon.raster.cpu.blend import RUN_TILES
from stga_addon.raster.cpu.rasterize import BufferPool, new_projection, sort_into_tiles
from stga_addon.raster.cpu.tiles import RUN_BUCKETS, SPLATS_PER_SORT, heaviest_first, whole_tiles

TILES = 4
"""Along each side of the image."""


@pytest.mark.parametrize("most", [1.0, 1.0 + 1e-6, 1.1, 3.0, 1e9, 3e38])
@pytest.mark.parametrize("least", [1.0, 0.01])
def test_depths_are_sorted_whatever_their_range(least, most):
    """Catches a pass left out where depths differ in high bits only, equal depths that change
    places, and parts that overlap or lose splats or pairs where they meet."""
    rng = np.random.default_rng(0)
    depth = np.geomspace(least, most, 3000).astype(np.float32)[rng.integers(0, 3000, 60_000)]
    rect = np.zeros((60_000, 4), np.int32)
    rect[:, :2] = rng.integers(0, TILES, (60_000, 2))
    rect[:, 2:] = np.minimum(rect[:, :2] + rng.integers(1, 4, (60_000, 2)), TILES)
    rect[rng.random(60_000) < 0.3] = 0
    seen = np.flatnonzero(rect[:, 2])
    assert len(seen) > 2 * SPLATS_PER_SORT
    buffers = BufferPool()
    projection = new_projection(len(depth), buffers)
    projection.depth[:] = depth
    projection.rect[:] = rect
    for _ in range(2):  # with too little room for the pairs, and with enough
        lists, tiles = sort_into_tiles(projection, TILES, whole_tiles(TILES * TILES), buffers)
        assert_array_equal(np.sort(tiles), np.arange(TILES * TILES))
        assert_array_equal(lists.visible, seen)
        count = ((rect[:, 2] - rect[:, 0]) * (rect[:, 3] - rect[:, 1]))[seen]
        assert_array_equal(lists.pairs[seen], count)
        assert_array_equal(lists.first_pair[seen], np.cumsum(count) - count)
        order = seen[np.argsort(depth[seen], kind="stable")]
        x0, y0, x1, y1 = rect[order].T
        expected = [
            order[(x0 <= n % TILES) & (n % TILES < x1) & (y0 <= n // TILES) & (n // TILES < y1)]
            for n in range(TILES * TILES)
        ]
        assert_array_equal(lists.pair_splat, np.concatenate(expected))
        assert_array_equal(np.diff(lists.start), [len(found) for found in expected])
        assert_array_equal(lists.pair_splat[lists.splat_pairs], np.repeat(seen, count))


@pytest.mark.parametrize("count", [1, 7, 8, 1785])
def test_runs_of_tiles_begin_with_the_fullest(count):
    """Catches tiles that are lost or doubled, neighbors that are torn apart, and a long run that is
    left to the end, where all threads but one wait for it."""
    rng = np.random.default_rng(1)
    pairs = rng.integers(0, 400, 1785)
    given = np.sort(rng.choice(1785, count, replace=False)).astype(np.int32)
    tiles = heaviest_first(given, np.append(0, np.cumsum(pairs)))
    assert_array_equal(np.sort(tiles), given)
    whole = count // RUN_TILES * RUN_TILES
    runs = tiles[:whole].reshape(-1, RUN_TILES)
    assert {tuple(run) for run in runs.tolist()} == {
        tuple(r) for r in given[:whole].reshape(-1, RUN_TILES).tolist()
    }
    weights = pairs[runs].sum(1)
    assert (np.diff(weights) <= weights.max(initial=0) / (RUN_BUCKETS - 1) + 1).all()
