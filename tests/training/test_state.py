"""Memory that a state shares."""

import numpy as np
from numpy.testing import assert_array_equal

from stga_addon.training.optimize.state import new_state

from .toys import random_splats


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
