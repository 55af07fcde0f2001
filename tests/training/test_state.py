"""Rows travel with everything that belongs to them."""

import numpy as np
from numpy.testing import assert_array_equal

from stga_addon.training.optimize.state import arrays_of, keep_rows, new_state

from .toys import random_splats, random_state


def test_rows_are_kept_whole():
    """Catches an array left at its old length or in another order after pruning or a split."""
    state = random_state(9, 5)
    rows = np.array([7, 1, 1, 8, 0])
    chosen = np.isin(np.arange(9), rows)
    for given, order in ((rows, rows), (chosen, np.flatnonzero(chosen))):
        kept = arrays_of(keep_rows(state, given))
        for name, array in arrays_of(state).items():
            assert_array_equal(kept[name], array[order], err_msg=name)
            assert kept[name].dtype == array.dtype
            assert kept[name].flags.c_contiguous


def test_memory_is_shared_where_promised_and_only_there():
    """Catches training that changes the splats it began with, and Adam on a copy."""
    splats = random_splats(6, 4)
    xyz = splats.xyz.copy()
    face = splats.face.copy()
    state = new_state(splats)
    copy = state.splats()
    state.parameters.xyz[:] += 1
    state.face[:] += 1
    assert_array_equal(splats.xyz, xyz)
    assert_array_equal(splats.face, face)
    assert_array_equal(copy.xyz, xyz)
    assert_array_equal(state.average.xyz, xyz)
    assert all(
        not array.any() for part in (state.gradients, state.first, state.second) for array in part
    )
    for name, table in state.tables.items():
        parts = (state.parameters, state.gradients, state.first, state.second, state.average)
        for array, part in zip(table, parts, strict=False):
            assert np.shares_memory(array, getattr(part, name)) or not array.size
