"""Order of the splats by depth against numpy's stable sort, and the order in which tiles are
rendered."""

import numpy as np
import pytest

pytest.importorskip("numba")

from stga_addon.raster.cpu.blend import RUN_TILES
from stga_addon.raster.cpu.rasterize import BufferPool, new_projection, sort_by_depth
from stga_addon.raster.cpu.tiles import RUN_BUCKETS, SPLATS_PER_SORT, heaviest_first


def by_depth(depth: np.ndarray, rect: np.ndarray) -> tuple[np.ndarray, ...]:
    """`sort_by_depth` of splats with depths (N,) and bounds (N, 4)."""
    projection = new_projection(len(depth), BufferPool())
    projection.depth[:] = depth
    projection.rect[:] = rect
    return sort_by_depth(projection, BufferPool())


@pytest.mark.parametrize("most", [1.0, 1.0 + 1e-6, 1.1, 3.0, 1e9, 3e38])
@pytest.mark.parametrize("least", [1.0, 0.01])
def test_depths_are_sorted_whatever_their_range(least, most):
    """Catches a pass left out where depths differ in high bits only, equal depths that change
    places, and parts that overlap or lose splats or pairs where they meet."""
    rng = np.random.default_rng(0)
    depth = np.geomspace(least, most, 3000).astype(np.float32)[rng.integers(0, 3000, 60_000)]
    rect = np.zeros((60_000, 4), np.int32)
    rect[:, 2:] = rng.integers(1, 5, (60_000, 2)) * (rng.random((60_000, 1)) < 0.7)
    visible, order, first_pair, pairs, total = by_depth(depth, rect)
    seen = np.flatnonzero(rect[:, 2])
    assert len(seen) > 2 * SPLATS_PER_SORT
    np.testing.assert_array_equal(visible, seen)
    np.testing.assert_array_equal(order, seen[np.argsort(depth[seen], kind="stable")])
    expected = rect[seen, 2] * rect[seen, 3]
    np.testing.assert_array_equal(pairs[seen], expected)
    np.testing.assert_array_equal(first_pair[seen], np.cumsum(expected) - expected)
    assert total == expected.sum()


@pytest.mark.parametrize("count", [1, 7, 8, 1785])
def test_runs_of_tiles_begin_with_the_fullest(count):
    """Catches tiles that are lost or doubled, neighbors that are torn apart, and a long run that is
    left to the end, where all threads but one wait for it."""
    rng = np.random.default_rng(1)
    pairs = rng.integers(0, 400, 1785)
    given = np.sort(rng.choice(1785, count, replace=False)).astype(np.int32)
    tiles = heaviest_first(given, np.append(0, np.cumsum(pairs)))
    np.testing.assert_array_equal(np.sort(tiles), given)
    whole = count // RUN_TILES * RUN_TILES
    runs = tiles[:whole].reshape(-1, RUN_TILES)
    assert {tuple(run) for run in runs.tolist()} == {
        tuple(r) for r in given[:whole].reshape(-1, RUN_TILES).tolist()
    }
    weights = pairs[runs].sum(1)
    assert (np.diff(weights) <= weights.max(initial=0) / (RUN_BUCKETS - 1) + 1).all()
