"""A capture and a run of it, which tests of the command line only read."""

from pathlib import Path

import pytest
from capture import factory

from stga_addon.cli.main import main

TIMESTEPS = (0, 1, 3)
CAMERAS = range(3)


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return factory.write_mesh_capture(tmp_path_factory.mktemp("cli") / "ball", TIMESTEPS, CAMERAS)


@pytest.fixture(scope="session")
def trained(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of ten iterations of the paper's schedule, with a threshold of its own."""
    out = tmp_path_factory.mktemp("runs") / "run"
    options = "--iterations 10 --schedule paper --threshold 0.005"
    assert main(["train", str(root), "--out", str(out), *options.split()]) == 0
    return out


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must fail: exit code 2 and one sentence on stderr, which is returned."""
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("stga: ")]
    assert len(lines) == 1
    return lines[0]
