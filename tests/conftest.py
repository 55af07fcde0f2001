"""Fixtures that several test folders share."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of development data (studio_head, raster_reference, …), which is not part of the project."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("STGA_DATA", beside))
    if not folder.is_dir():
        pytest.skip("shared data (studio_head, raster_reference, …) not present")
    return folder
