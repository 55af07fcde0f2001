"""How tests compare what was read with what was written."""

from collections.abc import Mapping

import numpy as np
from numpy.testing import assert_array_equal


def assert_same(found, expected, where="it"):
    """Plain values are equal, types and arrays included; where: what is said of a difference."""
    if not isinstance(expected, Mapping):
        assert type(found) is type(expected), where
    if isinstance(expected, np.ndarray):
        assert found.dtype == expected.dtype, where
        assert_array_equal(found, expected, err_msg=where)
        return
    ours, theirs = (parts(value) for value in (found, expected))
    if theirs is None:
        assert found == expected, where
        return
    assert ours.keys() == theirs.keys(), where
    for name, value in theirs.items():
        assert_same(ours[name], value, f"{where}.{name}")


def parts(value):
    """What a mapping, a tuple or an object of a dataclass holds, by name; None of any other."""
    if isinstance(value, tuple):
        return dict(enumerate(value))
    if hasattr(value, "__dataclass_fields__"):
        return vars(value)
    return dict(value) if isinstance(value, Mapping) else None
