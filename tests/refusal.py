"""What tests expect of mistakes."""

import pytest

from stga_addon.errors import StgaError


def refusal(sentence):
    """A block that ends with an error of the user's, in whose message the sentence is found."""
    return pytest.raises(StgaError, match=sentence)
