"""`stga benchmark` as typed."""

from pathlib import Path

import pytest
from capture import factory

from stga_addon.cli.main import main


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "fast"], "--only: 'fast' is not one of draft, standard"),
        (["--only", "draft", "--knobs"], "--only: 'draft' is not one of standard, scale-0.5"),
    ],
)
def test_impossible_benchmarks(
    toy_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    """Catches a mistake found only after the first hour."""
    assert main(["benchmark", str(toy_root), "--out", str(tmp_path / "out"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_benchmark_needs_held_out_views(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches an hour of training of which nothing can be said."""
    root = factory.write_mesh_capture(tmp_path / "one", (0,), range(2))
    (root / "transforms_val.json").unlink()
    assert main(["benchmark", str(root), "--out", str(tmp_path / "out")]) == 2
    assert "has no views to" in capsys.readouterr().err
