"""A toy capture that all tests of training share: a ball of 10 cm, of one color per view, seen by three cameras."""

from pathlib import Path

import pytest
from capture import factory

from stga_addon.capture.model import Capture
from stga_addon.capture.open import open_capture


@pytest.fixture(scope="session")
def toy_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Timesteps 0, 1, 3 and 4 (the last one is `test`), cameras 0 to 3 (the last one is `val`)."""
    return factory.write_mesh_capture(tmp_path_factory.mktemp("toy"), (0, 1, 3, 4), range(4))


@pytest.fixture(scope="session")
def toy(toy_root: Path) -> Capture:
    return open_capture(toy_root)
