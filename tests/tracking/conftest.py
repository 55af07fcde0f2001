"""The head that most takes here are of."""

import pytest
from flame.small_head import small_head

from stga_addon.tracking.head_model import HeadModel


@pytest.fixture(scope="session")
def head():
    return HeadModel(small_head(0), "flame")


@pytest.fixture
def without_surface(monkeypatch):
    """Images are not searched for the surface, which takes the longest."""
    monkeypatch.setattr(
        "stga_addon.tracking.fitted_head.fit_surface", lambda head, fit, *_, **__: fit
    )
