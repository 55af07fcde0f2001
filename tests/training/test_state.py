"""Rows travel with everything that belongs to them."""

import numpy as np
import pytest

from stga_addon.training.optimize.state import arrays_of, join, keep_rows, new_state, state_of

from .toys import random_splats, random_state


def test_flat_names_round_trip() -> None:
    """Catches an array that a checkpoint would lose or put under another's name."""
    state = random_state(9, 5)
    flat = arrays_of(state)
    assert len(flat) == 5 * 6 + 6
    some = {
        "parameters/xyz", "average/sh", "gradients/sh", "first/opacity", "second/rotation", "steps",
        "screen_gradient",
    }  # fmt: skip
    assert some <= set(flat)
    again = arrays_of(state_of(flat))
    assert list(again) == list(flat)
    assert all(again[name] is flat[name] for name in flat)
    del flat["second/sh"]
    with pytest.raises(KeyError, match="second/sh"):
        state_of(flat)


def test_keep_and_join() -> None:
    """Catches an array left at its old length or in another order after pruning, which would mix
    rows up."""
    state = random_state(9, 5)
    keep = np.array([True, False, True, True, False, False, True, False, True])
    kept, rest = keep_rows(state, keep), keep_rows(state, ~keep)
    assert (len(kept), len(rest)) == (5, 4)
    order = np.concatenate([np.flatnonzero(keep), np.flatnonzero(~keep)])
    joined = arrays_of(join(kept, rest))
    for name, array in arrays_of(state).items():
        np.testing.assert_array_equal(joined[name], array[order], err_msg=name)
        assert joined[name].dtype == array.dtype
        assert joined[name].flags.c_contiguous


def test_memory_is_shared_where_promised_and_only_there() -> None:
    """Catches training that changes the splats it started from, and Adam on a copy of the
    parameters."""
    splats = random_splats(6, 4)
    xyz, face = splats.xyz.copy(), splats.face.copy()
    state = new_state(splats)
    copy = state.splats()
    state.parameters.xyz[:] += 1
    state.face[:] += 1
    np.testing.assert_array_equal(splats.xyz, xyz)
    np.testing.assert_array_equal(splats.face, face)
    np.testing.assert_array_equal(copy.xyz, xyz)
    np.testing.assert_array_equal(state.average.xyz, xyz)
    assert all(
        not array.any() for part in (state.gradients, state.first, state.second) for array in part
    )
    for name, table in state.tables.items():
        parts = (state.parameters, state.gradients, state.first, state.second, state.average)
        for array, part in zip(table, parts, strict=False):
            assert np.shares_memory(array, getattr(part, name)) or not array.size
