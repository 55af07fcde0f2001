"""A capture and a run of it, which tests of the command line only read."""

import pytest
from capture import factory
from command_line import stga

TIMESTEPS = (0, 1, 3)
CAMERAS = range(3)


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    return factory.write_mesh_capture(tmp_path_factory.mktemp("cli") / "ball", TIMESTEPS, CAMERAS)


@pytest.fixture(scope="session")
def trained(root, tmp_path_factory):
    """A run of ten iterations of the paper's schedule, with a threshold of its own."""
    out = tmp_path_factory.mktemp("runs") / "run"
    options = "--iterations 10 --schedule paper --threshold 0.005"
    assert stga("train", root, "--out", out, options) == 0
    return out
